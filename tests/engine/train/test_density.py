"""Growing and pruning, on a block's own clock."""

import math

import pytest
import torch
from gsplat.strategy import MCMCStrategy

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.gaussians.param_swap import active_gaussians, attach, nothing_active
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density import control as control_module
from abcd_ns.engine.train.density.control import DensityClock, DensityConfig, DensityControl
from abcd_ns.engine.train.density.relocation import compute_relocation
from abcd_ns.engine.train.density.worth import WORTH
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from abcd_ns.errors import UserError
from tests.reference.scenes import random_gaussians

VIEWS = 5
BINOMIALS = MCMCStrategy().initialize_state()["binoms"]


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
        **{"progress": 0.2, "steps": 100, "taken": 1, "views": VIEWS, "room": None, "seed": 1, **changes}
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


def test_mcmc_relocates_the_dead_and_grows_up_to_the_limit(monkeypatch):
    monkeypatch.setattr("abcd_ns.engine.train.density.control.MCMC_NOISE_LR", 0.0)
    gaussians = random_gaussians(100)
    gaussians.opacities[:] = 2.0
    gaussians.opacities[:10] = -9.0
    params, optimizers = active(gaussians)
    control = DensityControl(DensityConfig(strategy="mcmc"))
    control.after_step(params, optimizers, {}, (), (), clock(room=3))
    assert len(params["means"]) == 103
    assert float(torch.sigmoid(params["opacities"].detach()).min()) > 0.005
    control.after_step(params, optimizers, {}, (), (), clock(room=0))
    assert len(params["means"]) == 103


def test_mcmc_leaves_the_dead_where_none_is_alive():
    gaussians = random_gaussians(20)
    gaussians.opacities[:] = -9.0
    params, optimizers = active(gaussians)
    DensityControl(DensityConfig(strategy="mcmc")).after_step(params, optimizers, {}, (), (), clock(room=3))
    assert len(params["means"]) == 20


def test_mcmc_noise_moves_the_transparent_and_depends_on_the_seed():
    gaussians = random_gaussians(20, size=0.5)
    gaussians.opacities[:10], gaussians.opacities[10:] = -6.0, 6.0
    control = DensityControl(DensityConfig(strategy="mcmc"))
    moved = []
    for seed in (1, 1, 2):
        params, optimizers = active(gaussians)
        before = torch.get_rng_state()
        control.after_step(params, optimizers, {}, (), (), clock(steps=7, refined=7, seed=seed))
        assert torch.equal(torch.get_rng_state(), before)
        moved.append(active_gaussians(params).means.detach() - gaussians.means)
    assert torch.equal(moved[0], moved[1])
    assert not torch.equal(moved[0], moved[2])
    assert float(moved[0][:10].norm()) > 10 * float(moved[0][10:].norm())


@pytest.mark.parametrize("copies", [2, 5])
def test_relocated_copies_have_together_the_opacity_of_the_original(copies):
    opacities, scales = torch.tensor([0.7]), torch.tensor([[0.3, 0.2, 0.1]])
    new, _ = compute_relocation(opacities, scales, torch.tensor([copies]), BINOMIALS)
    assert float((1 - new) ** copies) == pytest.approx(0.3, abs=1e-6)


def test_relocation_keeps_the_mass_along_a_ray():
    """Equation 9 equates the integrals over a line through the centre; here by quadrature."""
    opacity, sigma, copies = 0.7, 0.3, 3
    new, scale = compute_relocation(
        torch.tensor([opacity]), torch.full((1, 3), sigma), torch.tensor([copies]), BINOMIALS
    )
    x = torch.linspace(-6, 6, 20001, dtype=torch.float64)

    def mass(o: float, s: float, n: int) -> float:
        return float(torch.trapezoid(1 - (1 - o * torch.exp(-(x**2) / (2 * s * s))) ** n, x))

    assert mass(float(new), float(scale[0, 0]), copies) == pytest.approx(mass(opacity, sigma, 1), rel=1e-4)


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
