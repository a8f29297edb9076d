"""What every method learns on a tiny scene is what it learnt before: tests/reference/loss_curves.json."""

import json

import pytest

from tests.reference.loss_curves import CURVES, METHODS, STEPS, curve_of

KNOWN = json.loads(CURVES.read_text(encoding="utf-8"))


@pytest.mark.parametrize("method", METHODS)
def test_a_method_learns_as_it_did(method, tmp_path):
    """If the change is meant: `python -m tests.reference.loss_curves`, and look at the difference."""
    found = curve_of(method, tmp_path)
    assert len(found["psnr"]) == STEPS
    # Another processor rounds otherwise, and what grows by a threshold may then be one more or less.
    assert found["gaussians"] == pytest.approx(KNOWN[method]["gaussians"], rel=0.02)
    assert found["psnr"] == pytest.approx(KNOWN[method]["psnr"], abs=0.1)
