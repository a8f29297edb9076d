"""Growing and pruning, on a block's own clock."""

import math

import pytest
import torch
from gsplat.strategy import DefaultStrategy

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.gaussians.param_swap import attach, live_gaussians, nothing_live
from abcd_ns.engine.render.primitive import SPLATS, SURFELS
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density import control as control_module
from abcd_ns.engine.train.density.clock import DensityClock
from abcd_ns.engine.train.density.control import DensityConfig, DensityControl, for_primitive
from abcd_ns.engine.train.density.relocation import binomials, compute_relocation
from abcd_ns.engine.train.health.health_rules import GIANT_ANGLE, wider_than
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from abcd_ns.errors import UserError
from tests.reference.scenes import random_gaussians, ring_of_views


def live(gaussians: Gaussians):
    params, optimizers = nothing_live(gaussians.sh_degree)
    attach(BlockState.fresh(gaussians), params, optimizers)
    return params, optimizers


def fake_info(count: int, gradient: float) -> dict:
    """What a drawing leaves behind, with the same gradient for every Gaussian."""
    means2d = torch.zeros(1, count, 2, requires_grad=True)
    means2d.grad = torch.full((1, count, 2), gradient)
    means2d.absgrad = means2d.grad.clone()
    radii = torch.ones(1, count, dtype=torch.int32)
    return {"means2d": means2d, "radii": radii, "width": 2, "height": 2, "n_cameras": 1, "gaussian_ids": None}


@pytest.fixture
def no_cap(monkeypatch):
    """All may be split in one refinement."""
    monkeypatch.setattr(control_module, "MOST_NEW", 1.0)


def clock(**changes) -> DensityClock:
    return DensityClock(
        **{"progress": 0.2, "steps": 100, "taken": 1, "views": 5, "room": None, "seed": 1, **changes}
    )


@pytest.mark.usefixtures("no_cap")
def test_the_default_strategy_makes_two_where_gradients_are_high():
    params, optimizers = live(random_gaussians(8, size=0.001))
    control = DensityControl(DensityConfig(densify_grad_thresh=0.5, cull_alpha_thresh=0.0))
    growth = control.after_step(params, optimizers, {}, (fake_info(8, gradient=1.0),), clock())
    assert len(params["means"]) == 16
    assert {name: len(value) for name, value in growth.items()} == {"grad2d": 16, "count": 16}
    assert all(len(optimizers[n].param_groups[0]["params"][0]) == 16 for n in PARAM_NAMES)


@pytest.mark.parametrize(("room", "added"), [(None, 30), (200, 30), (12, 12), (0, 0)])
def test_a_refinement_adds_at_most_a_tenth_best_first(room, added):
    params, optimizers = live(random_gaussians(300, size=0.001))
    control = DensityControl(DensityConfig(densify_grad_thresh=0.5, cull_alpha_thresh=0.0))
    info = fake_info(300, gradient=1.0)
    info["means2d"].absgrad *= 1 + torch.arange(300.0)[None, :, None]
    before = params["means"].detach().clone()
    control.after_step(params, optimizers, {}, (info,), clock(room=room))
    assert len(params["means"]) == 300 + added
    assert torch.equal(params["means"][: 300 - added], before[: 300 - added])  # the best are the last


def test_what_is_too_wide_is_measured_by_the_nearest_camera():
    views = ring_of_views(3)
    gaussians = random_gaussians(20)
    nearest = torch.stack([(gaussians.means - view.center).norm(dim=1) for view in views]).amin(dim=0)
    gaussians.scales[:] = (GIANT_ANGLE * nearest * 0.99).log()[:, None]
    gaussians.scales[4, 1] += 0.02
    over, _ = wider_than(GIANT_ANGLE, gaussians.scales, gaussians.means, views)
    assert over.nonzero().tolist() == [[4, 1]]


def test_between_refinements_statistics_add_up():
    params, optimizers = live(random_gaussians(8))
    control = DensityControl(DensityConfig())
    growth: dict = {}
    for _ in range(3):
        growth = control.after_step(params, optimizers, growth, (fake_info(8, 1.0),), clock(steps=7))
    assert growth["count"].tolist() == [3.0] * 8
    assert growth["grad2d"].tolist() == pytest.approx([3 * math.sqrt(2)] * 8)
    assert len(params["means"]) == 8


def test_without_room_nothing_is_added_but_the_transparent_go():
    gaussians = random_gaussians(8, size=0.001)
    gaussians.opacities[:] = 2.0
    gaussians.opacities[:3] = -8.0
    params, optimizers = live(gaussians)
    control = DensityControl(DensityConfig(densify_grad_thresh=0.5))
    control.after_step(params, optimizers, {}, (fake_info(8, 1.0),), clock(room=0))
    assert torch.equal(params["means"], gaussians.means[3:])


def test_opacities_are_reset_on_the_blocks_own_clock_alone():
    gaussians = random_gaussians(8)
    gaussians.opacities[:] = 3.0
    control = DensityControl(DensityConfig(reset_every=500))
    for steps, reset in ((499, False), (500, True), (501, False), (1000, True)):
        params, optimizers = live(gaussians)
        control.after_step(params, optimizers, {}, (fake_info(8, 0.0),), clock(steps=steps))
        assert bool((torch.sigmoid(params["opacities"]) < 0.02).all()) is reset, steps


@pytest.mark.usefixtures("no_cap")
@pytest.mark.parametrize(("views", "visit"), [(1, None), (3000, 40)])
def test_only_those_grow_that_fill_several_prices(views, visit):
    """Eight alike by their gradients, of which the last four fill too little in all views, however few of
    them a visit draws."""
    gaussians = random_gaussians(8, size=0.005)
    params, optimizers = live(gaussians)
    growth = {
        "grad2d": torch.full((8,), 9.0),
        "count": torch.ones(8),
        "weight": torch.tensor([13.0] * 4 + [11.0] * 4) / views,
        "passes": torch.full((8,), 1 / views),
    }
    control = DensityControl(DensityConfig(price=3.0, refine_every=10))
    now = clock(steps=40, taken=40, views=views, visit=visit)
    growth = control.after_step(params, optimizers, growth, (fake_info(8, 0.0),), now)
    assert len(params["means"]) == 12
    assert all(len(value) == 12 for value in growth.values())


def test_after_the_last_refinement_nothing_changes():
    params, optimizers = live(random_gaussians(8))
    control = DensityControl(DensityConfig())
    control.after_step(params, optimizers, {}, (fake_info(8, 9.0),), clock(progress=0.6))
    assert len(params["means"]) == 8


def test_mcmc_relocates_the_dead_and_grows_up_to_the_limit(monkeypatch):
    monkeypatch.setattr("abcd_ns.engine.train.density.control.MCMC_NOISE_LR", 0.0)
    gaussians = random_gaussians(100)
    gaussians.opacities[:] = 2.0
    gaussians.opacities[:10] = -9.0
    params, optimizers = live(gaussians)
    control = DensityControl(DensityConfig(strategy="mcmc"))
    control.after_step(params, optimizers, {}, (), clock(room=3))
    assert len(params["means"]) == 103
    assert float(torch.sigmoid(params["opacities"].detach()).min()) > 0.005
    control.after_step(params, optimizers, {}, (), clock(room=0))
    assert len(params["means"]) == 103


def test_mcmc_leaves_the_dead_where_none_is_alive():
    gaussians = random_gaussians(20)
    gaussians.opacities[:] = -9.0
    params, optimizers = live(gaussians)
    DensityControl(DensityConfig(strategy="mcmc")).after_step(params, optimizers, {}, (), clock(room=3))
    assert len(params["means"]) == 20


def test_mcmc_noise_moves_the_transparent_and_depends_on_the_seed():
    gaussians = random_gaussians(20, size=0.5)
    gaussians.opacities[:10], gaussians.opacities[10:] = -6.0, 6.0
    control = DensityControl(DensityConfig(strategy="mcmc"))
    moved = []
    for seed in (1, 1, 2):
        params, optimizers = live(gaussians)
        before = torch.get_rng_state()
        control.after_step(params, optimizers, {}, (), clock(steps=7, seed=seed))
        assert torch.equal(torch.get_rng_state(), before)
        moved.append(live_gaussians(params).means.detach() - gaussians.means)
    assert torch.equal(moved[0], moved[1])
    assert not torch.equal(moved[0], moved[2])
    assert float(moved[0][:10].norm()) > 10 * float(moved[0][10:].norm())


@pytest.mark.parametrize("copies", [1, 2, 5])
def test_relocated_copies_have_together_the_opacity_of_the_original(copies):
    opacities, scales = torch.tensor([0.7]), torch.tensor([[0.3, 0.2, 0.1]])
    new, _ = compute_relocation(opacities, scales, torch.tensor([copies]), binomials())
    assert float((1 - new) ** copies) == pytest.approx(0.3, abs=1e-6)


def test_relocation_keeps_the_mass_along_a_ray():
    """Equation 9 equates the integrals over a line through the centre; here by quadrature."""
    opacity, sigma, copies = 0.7, 0.3, 3
    new, scale = compute_relocation(
        torch.tensor([opacity]), torch.full((1, 3), sigma), torch.tensor([copies]), binomials()
    )
    x = torch.linspace(-6, 6, 20001, dtype=torch.float64)

    def mass(o: float, s: float, n: int) -> float:
        return float(torch.trapezoid(1 - (1 - o * torch.exp(-(x**2) / (2 * s * s))) ** n, x))

    assert mass(float(new), float(scale[0, 0]), copies) == pytest.approx(mass(opacity, sigma, 1), rel=1e-4)


def test_surfels_grow_by_plain_gradients_and_2dgs_threshold():
    found = for_primitive(DensityConfig(), SURFELS)
    assert not found.use_absgrad
    assert math.isclose(found.densify_grad_thresh, 2e-4)
    plain = DensityConfig(use_absgrad=False, densify_grad_thresh=3e-4)
    assert for_primitive(plain, SURFELS).densify_grad_thresh == 3e-4
    assert for_primitive(DensityConfig(), SPLATS) == DensityConfig()


def test_what_is_large_stays_though_opacities_were_reset():
    """Sky and far background are; what is large for every camera is held back by angle."""
    gaussians = random_gaussians(8, size=0.01)
    gaussians.opacities[:] = 3.0
    gaussians.scales[0] = math.log(5.0)
    control = DensityControl(DensityConfig(reset_every=500, refine_every=10))
    params, optimizers = live(gaussians)
    control.after_step(params, optimizers, {}, (fake_info(8, 0.0),), clock(steps=510))
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


def test_a_reset_needs_no_gradients():
    """Those of a step may be unsound."""
    gaussians = random_gaussians(8)
    gaussians.opacities[:] = 3.0
    params, optimizers = live(gaussians)
    growth = {"grad2d": torch.ones(8), "count": torch.ones(8)}
    control, due = DensityControl(DensityConfig(reset_every=500)), clock(steps=500)
    assert control.resets(due)
    found = control.after_step(params, optimizers, growth, (), due)
    assert bool((torch.sigmoid(params["opacities"]) < 0.02).all())
    assert {name: value.tolist() for name, value in found.items()} == {n: [1.0] * 8 for n in growth}


def test_refining_needs_gradients():
    control, due = DensityControl(DensityConfig()), clock()
    assert control.refines(due, (fake_info(3, 1.0),))
    assert not control.refines(due, ())
    assert not control.refines(clock(steps=101), (fake_info(3, 1.0),))
    assert DensityControl(DensityConfig("mcmc")).refines(due, ())


def drawn_info(views: int, count: int, seed: int, size) -> dict:
    """What a drawing leaves behind: not every view sees every Gaussian."""
    generator = torch.Generator().manual_seed(seed)
    means2d = torch.zeros(views, count, 2, requires_grad=True)
    radii = torch.randint(0, 3, (views, count), generator=generator, dtype=torch.int32)
    unseen = (radii == 0)[..., None]
    means2d.grad = (torch.randn(views, count, 2, generator=generator) * 1e-4).masked_fill(unseen, 0.0)
    means2d.absgrad = means2d.grad.abs() * 3
    return {"means2d": means2d, "radii": radii, "n_cameras": 5, "gaussian_ids": None, **size}


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("count", [1, 2, 37, 1000])
@pytest.mark.parametrize("views", [1, 2, 4, 33])
def test_statistics_are_gsplats_to_the_last_bit(views, count, absgrad):
    sizes = torch.arange(2 * views).view(2, views, 1) + 40
    infos = (
        drawn_info(views, count, 0, {"width": 641, "height": 427}),
        drawn_info(views, count, 1, {"width": sizes[0], "height": sizes[1]}),
    )
    control = DensityControl(DensityConfig(use_absgrad=absgrad))
    state: dict = {"grad2d": None, "count": None}
    strategy = DefaultStrategy(absgrad=absgrad)
    for info in infos:
        strategy._update_state({"means": torch.zeros(count, 3)}, state, info)
    found = control.count(torch.zeros(count, 3), infos, 1)
    assert {name: value.dtype for name, value in found.items()} == dict.fromkeys(state, torch.float32)
    assert all(torch.equal(found[name], value) for name, value in state.items())


def test_statistics_pass_over_what_is_no_number():
    info = fake_info(4, 1.0)
    info["means2d"].absgrad[0, 2] = math.nan
    found = DensityControl(DensityConfig()).count(torch.zeros(4, 3), (info,), 1)
    assert found["count"].tolist() == [1, 1, 0, 1]
    assert float(found["grad2d"][2]) == 0


def test_random_numbers_are_forked_only_where_any_are_drawn(monkeypatch):
    """It takes a wait on a device."""
    forks, fork = [], torch.random.fork_rng
    monkeypatch.setattr(torch.random, "fork_rng", lambda **options: forks.append(1) or fork(**options))
    params, optimizers = live(random_gaussians(8))
    control = DensityControl(DensityConfig())
    growth = control.after_step(params, optimizers, {}, (fake_info(8, 1.0),), clock(steps=7))
    assert forks == []
    control.after_step(params, optimizers, growth, (fake_info(8, 1.0),), clock())
    assert forks == [1]


@pytest.mark.usefixtures("no_cap")
def test_a_refinement_leaves_the_allocator_its_memory(monkeypatch):
    emptied = []
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: emptied.append(1))
    lent = torch.cuda.empty_cache
    params, optimizers = live(random_gaussians(8, size=0.001))
    control = DensityControl(DensityConfig(densify_grad_thresh=0.5, cull_alpha_thresh=0.0))
    control.after_step(params, optimizers, {}, (fake_info(8, 1.0),), clock())
    assert len(params["means"]) == 16
    assert emptied == []
    assert torch.cuda.empty_cache is lent
