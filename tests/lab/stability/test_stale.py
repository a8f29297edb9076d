"""What a scenario swaps in is what a run uses."""

from functools import partial

import torch

from abcd_ns.lab.stability.lab import STILL, Lab, make_stage
from abcd_ns.lab.stability.scenarios.schedules import stale_coordinator


def means_after_a_visit(folder, damping):
    """(before, after) of the block that is trained first."""
    stage, lab = make_stage(points=100), Lab(folder, use_native=False)
    kind = partial(stale_coordinator, every=1, damping=damping)
    options = {"blocks": 2, "warmup": 0.0, "density": STILL, "kind": kind}
    coordinator = lab.coordinator(stage.start(), stage.views, budget=48, **options)
    before = [coordinator.scene.gaussians(block).means.clone() for block in range(2)]
    lab.finish(coordinator, stage, steps=1)
    block = coordinator.run.active.geometry.block
    while coordinator.state.active is not None:
        lab.finish(coordinator, stage, steps=1)
    return before[block], coordinator.scene.gaussians(block).means


def test_a_damped_visit_goes_half_as_far(tmp_path):
    whole, half = (means_after_a_visit(tmp_path, damping) for damping in (1.0, 0.5))
    moved = [(after - before).norm() for before, after in (whole, half) if len(before) == len(after)]
    assert len(moved) == 2
    torch.testing.assert_close(moved[1], moved[0] / 2, rtol=1e-3, atol=0.0)
