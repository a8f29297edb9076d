"""The paper's choices, each an option: what it changes, and that the default is without it."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.events import VisitBegan
from abcd_ns.engine.render.loss import photometric_loss
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.schedule import plan_sweep
from abcd_ns.engine.train.training_loop import train, train_step
from tests.reference.scenes import listen, make_coordinator

STILL = DensityConfig(strategy="off")


@given(views=st.dictionaries(st.integers(0, 9), st.integers(0, 50), min_size=1), each=st.integers(1, 500))
def test_every_visit_has_the_same_steps_whatever_its_views(views, each):
    plans = plan_sweep(0, views, 3, None, 0, each)
    assert {p.block: p.steps for p in plans} == {b: each for b, n in views.items() if n > 0}


def test_fixed_steps_for_each_cell_are_one_visit_to_each(tmp_path, views, photos, start):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=4, steps=20, visit_steps=5, batch=1, density=STILL
    )
    begun = listen(coordinator, VisitBegan)
    train(coordinator, photos)
    assert [event.steps for event in begun] == [5] * 4
    assert {event.block for event in begun} == {0, 1, 2, 3}


@pytest.mark.parametrize("keep", [True, False])
def test_moments_are_forgotten_at_the_next_visit_only_when_asked(tmp_path, views, photos, start, keep):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=2, steps=30, visit_steps=3, batch=1, density=STILL, keep_moments=keep
    )
    train(coordinator, photos, steps=6)
    coordinator.next_batch()
    block = coordinator.state.active.geometry.block
    stored = coordinator.scene.state(block)
    assert stored.clocks.adam_views == 3
    adam = coordinator.optimizers["scales"].state[coordinator.params["scales"]]
    assert int(adam["step"]) == (3 if keep else 0)
    assert bool(adam["exp_avg"].any()) == keep
    assert coordinator.visit.live.clocks.visits == 1


def test_a_run_without_moments_can_be_resumed_within_a_visit(tmp_path, views, photos, start):
    options = {"steps": 16, "visit_steps": 4, "batch": 1, "density": STILL, "keep_moments": False}
    options |= {"sh_restart": True, "migrate": False}
    runs = {}
    for name in ("whole", "stopped"):
        (tmp_path / name).mkdir()
        runs[name] = make_coordinator(tmp_path / name, start, views, blocks=2, **options)
    train(runs["whole"], photos)
    train(runs["stopped"], photos, steps=10)
    runs["stopped"].save()
    runs["stopped"].scene.store.close()
    again = make_coordinator(tmp_path / "stopped", start, views, resume=True, **options)
    train(again, photos)
    for block in range(2):
        found, expected = again.scene.gaussians(block), runs["whole"].scene.gaussians(block)
        assert all(torch.equal(value, getattr(found, name)) for name, value in expected.items())


def test_the_degree_begins_at_0_in_every_visit_and_layers_have_the_highest(tmp_path, views, photos, start):
    options = {"visit_steps": 4, "batch": 1, "density": STILL, "sh_restart": True, "sh_ramp": 0.5}
    coordinator = make_coordinator(tmp_path, start, views, blocks=2, steps=16, **options)
    degrees = []
    while not coordinator.finished:
        coordinator.next_batch()
        degrees.append(coordinator.run.sh_degree)
        assert coordinator.state.active.sh_degree == 1
        train_step(coordinator, photos)
    assert degrees == [0, 0, 1, 1] * 4


@pytest.mark.parametrize("migrate", [True, False])
def test_leavers_are_deleted_only_when_asked(tmp_path, views, photos, start, migrate):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=2, steps=8, visit_steps=4, batch=1, density=STILL, migrate=migrate
    )
    train(coordinator, photos, steps=3)
    block = coordinator.state.active.geometry.block
    with torch.no_grad():
        coordinator.params["means"][:5] = coordinator.scene.gaussians(1 - block).means[:5]
    train(coordinator, photos, steps=1)
    assert coordinator.count() == (120 if migrate else 115)
    means = coordinator.scene.gaussians(block).means
    assert bool((coordinator.scene.tree.assign(means) == block).all())


@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2])
def test_l2_is_the_mean_squared_difference(ssim_lambda):
    generator = torch.Generator().manual_seed(0)
    rendered, photo = (torch.rand(20, 30, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    sizes = {"full_pixels": 600, "full_windows": 200, "ssim_lambda": ssim_lambda}
    losses, gradients = {}, {}
    for kind in ("l1", "l2"):
        picture = rendered.clone().requires_grad_()
        losses[kind] = photometric_loss(picture, photo, pixel_loss=kind, **sizes)
        losses[kind].backward()
        gradients[kind] = picture.grad
    apart = rendered - photo
    expected = (1 - ssim_lambda) * (apart.square().mean() - apart.abs().mean())
    assert torch.allclose(losses["l2"] - losses["l1"], expected, rtol=1e-9)
    by_pixel = (1 - ssim_lambda) / apart.numel() * (2 * apart - apart.sign())
    assert torch.allclose(gradients["l2"] - gradients["l1"], by_pixel, rtol=1e-9, atol=1e-12)
