"""`python -m benchmarks.device`, with tiny settings."""

import json

import pytest

from benchmarks.device import Args, main


def test_the_benchmark_counts_and_writes(tmp_path, capsys):
    out = tmp_path / "results" / "device.json"
    main(Args(out, (1, 2), steps=4, views=3, gaussians=60, width=32))
    found = json.loads(out.read_text())
    one, two = found["runs"]
    assert (one["blocks"], two["blocks"]) == (1, 2)
    assert one["steps"] == two["steps"] == 4
    for each in (one, two):
        assert each["launches_per_step"] > 30
        assert each["waits_per_step"] >= each["waits_per_plain_step"] > 0
        assert each["copies_to_host_per_step"] > 0
        assert each["waits_in_isect_tiles_per_step"] == 1
        assert 0 < each["plain_steps"] <= each["steps"]
        assert each["waits_per_step"] == pytest.approx(
            sum(each["waits_per_step_by_operation"].values()), abs=0.1
        )
        # One view's photo at least, in float32.
        assert each["bytes_to_device_per_step"] > 0
        assert each["copies_to_device_per_step"] > 0
        assert each["peak_bytes"] > 4 * 23 * 30
    assert one["layer_copies_per_visit"] == two["layer_copies_per_visit"] == 0
    printed = capsys.readouterr().out
    assert "| a step | 1 block | 2 blocks |" in printed
    assert {"torch", "gsplat", "python"} <= set(found["versions"])
