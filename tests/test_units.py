"""Bytes are told in GiB and MiB, and in nothing else."""

import pytest

from abcd_ns.units import GIB, MIB, bytes_in_words


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (0, "0 MiB"),
        (50_000, "0.048 MiB"),
        (1.44 * MIB, "1.4 MiB"),
        (9.96 * MIB, "10 MiB"),
        (10.5 * MIB + 1, "11 MiB"),
        (GIB - MIB, "1023 MiB"),
        (GIB, "1.0 GiB"),
        (24.26 * GIB, "24.3 GiB"),
    ],
)
def test_bytes_in_words(count, words):
    assert bytes_in_words(count) == words
