"""Growing and pruning, on a block's own clock."""

import math

import pytest
import torch

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.gaussians.param_swap import attach, nothing_active
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density import control as control_module
from abcd_ns.engine.train.density.control import DensityClock, DensityConfig, DensityControl
from abcd_ns.engine.train.density.worth import WORTH
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from abcd_ns.errors import UserError
from tests.reference.scenes import random_gaussians

VIEWS = 5


def active(gaussians: Gaussians):
    params, optimizers = nothing_active(gaussians.sh_degree)
    attach(BlockState.fresh(gaussians), params, optimizers)
    return params, optimizers


def statistics(*gains: float) -> dict[str, torch.Tensor]:
    """By which a split of each along its middle axis removes so much squared error, where a pixel has 1."""
    found = torch.zeros(len(gains), 27)
    for half in (0, 12):
        found[:, half + 3] = (torch.tensor(gains) / VIEWS / 2).sqrt()
        found[:, half + 9 : half + 12] = 1.0
    found[:, 24:] = 1.0
    return {WORTH: found}


def clock(**changes) -> DensityClock:
    return DensityClock(
        **{"progress": 0.2, "steps": 100, "taken": 1, "views": VIEWS, "room": None, **changes}
    )


def test_the_default_strategy_splits_what_is_worth_it(monkeypatch):
    monkeypatch.setattr(control_module, "MOST_NEW", 1.0)
    gaussians = random_gaussians(8, size=0.001)
    params, optimizers = active(gaussians)
    control = DensityControl(DensityConfig(split_pixels=6.0, cull_alpha_thresh=0.0))
    growth = statistics(*[7.0] * 5, *[5.0] * 3)
    growth, refined = control.after_step(params, optimizers, growth, (), (), clock())
    assert refined
    assert len(params["means"]) == 13
    assert not bool(growth[WORTH].any())
    assert growth[WORTH].shape == (13, 27)
    assert all(len(optimizers[n].param_groups[0]["params"][0]) == 13 for n in PARAM_NAMES)
    narrower = params["scales"].detach()[3:8] < gaussians.scales[:5] - 0.1
    assert narrower.tolist() == [[False, True, False]] * 5


@pytest.mark.parametrize(("room", "added"), [(None, 30), (200, 30), (12, 12), (0, 0)])
def test_a_refinement_adds_at_most_a_tenth_best_first(room, added):
    params, optimizers = active(random_gaussians(300, size=0.001))
    control = DensityControl(DensityConfig(cull_alpha_thresh=0.0))
    before = params["means"].detach().clone()
    control.after_step(params, optimizers, statistics(*range(100, 400)), (), (), clock(room=room))
    assert len(params["means"]) == 300 + added
    assert torch.equal(params["means"][: 300 - added], before[: 300 - added])  # the best are the last


def test_without_room_nothing_is_added_but_the_transparent_go():
    gaussians = random_gaussians(8, size=0.001)
    gaussians.opacities[:] = 2.0
    gaussians.opacities[:3] = -8.0
    params, optimizers = active(gaussians)
    control = DensityControl(DensityConfig())
    control.after_step(params, optimizers, statistics(*[99.0] * 8), (), (), clock(room=0))
    assert torch.equal(params["means"], gaussians.means[3:])


def test_what_is_large_stays():
    """Sky and far background are; what is large for every camera is held back by angle."""
    gaussians = random_gaussians(8, size=0.01)
    gaussians.opacities[:] = 3.0
    gaussians.scales[0] = math.log(5.0)
    control = DensityControl(DensityConfig(refine_every=10))
    params, optimizers = active(gaussians)
    control.after_step(params, optimizers, statistics(*[0.0] * 8), (), (), clock(steps=510))
    assert len(params["means"]) == 8


@pytest.mark.parametrize("option", [{"antialiased": True}, {"poses": "SO3xR3"}])
def test_what_gsplats_surfels_lack_is_refused(option):
    TrainingConfig(**option).check()
    with pytest.raises(UserError, match=f"{next(iter(option))} is for 3dgs"):
        TrainingConfig(primitive="2dgs", **option).check()


def test_clocks_of_older_versions_are_read():
    """They counted resets, too."""
    meta = {"clocks": {**vars(Clocks(steps=2, visits=1)), "resets": 3}}
    assert BlockState.clocks_of(meta) == Clocks(steps=2, visits=1)
