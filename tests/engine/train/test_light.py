"""Photos that were taken in different light: a transform of each finished picture makes good for it."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.train.capture import bilateral_grid
from abcd_ns.engine.train.capture.light import Light, Use, gradients_of, lit
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import PARAM_NAMES, Crop
from abcd_ns.errors import UserError
from tests.reference.scenes import (
    Photos,
    make_coordinator,
    random_gaussians,
    ring_of_views,
    training_config,
    whole_scene,
)

STILL = DensityConfig(strategy="off")
GAINS = (0.75, 1.0, 1.25)
"""Their mean is 1: the light that held-out views are drawn in."""
TRUTH = random_gaussians(150, seed=7, size=0.12)


class Drifting(Photos):
    """Photos whose exposure changes from one to the next."""

    def __call__(self, index, crop):
        return (GAINS[index % 3] * super().__call__(index, crop)).clamp(0, 1)


IDENTITY = {"affine": torch.eye(3, 4), "exposure": torch.eye(3, 4)}
IDENTITY["bilateral"] = torch.eye(3, 4).view(12, 1, 1, 1).expand(12, *bilateral_grid.SHAPE)


class Shaded(Photos):
    """Photos that are brighter towards one side each, and darker towards the other."""

    TOWARDS = ((1, 0), (0, 1), (-1, 0), (0, -1), (1, 0), (-1, 0))

    def __call__(self, index, crop):
        photo, (right, down) = self.images[index], self.TOWARDS[index]
        x, y = (torch.linspace(-0.5, 0.5, size) for size in (photo.shape[1], photo.shape[0]))
        return (photo * (1 + 0.7 * (right * x + down * y[:, None]))[..., None]).clamp(0, 1)[crop.slices]


@pytest.fixture(scope="module")
def ring():
    return ring_of_views(6)


@pytest.fixture(scope="module")
def drifting(ring):
    return Drifting(TRUTH, ring)


@pytest.fixture
def make(tmp_path, ring):
    """Makes coordinators that begin with the truth, each in a folder of its own or in an earlier one's."""

    def made(name: str = "run", **options):
        (tmp_path / name).mkdir(exist_ok=True)
        return make_coordinator(tmp_path / name, TRUTH, ring, **{"density": STILL, **options})

    return made


@pytest.fixture
def error(make, ring):
    """Gives how far a trained scene is from the truth that its photos show, in some light: L1."""

    def found(name: str, photos, light: str, **options) -> float:
        made = make(name, light=light, background="black", **options)
        train(made, photos)
        scene, draw = whole_scene(made), TorchRasterizer()
        with torch.no_grad():
            pictures = [draw(scene, view, sh_degree=1).color.clamp(0, 1) for view in ring]
        pairs = zip(pictures, ring, strict=True)
        return float(torch.stack([(p - photos.images[v.index]).abs().mean() for p, v in pairs]).mean())

    return found


def transforms(light: Light) -> torch.Tensor:
    return torch.stack([light.of(view).detach() for view in sorted(light._rows)])


@given(st.integers(0, 10**6), st.integers(1, 6), st.sampled_from(["exposure", "affine", "bilateral"]))
def test_the_mean_transform_is_the_identity_whatever_the_gradients(seed, steps, kind):
    generator, light = torch.Generator().manual_seed(seed), Light(kind, range(5))
    for _ in range(steps):
        shown = torch.randint(5, (3,), generator=generator).tolist()  # the same view twice, at times
        shape = IDENTITY[kind].shape
        light.step([(view, torch.randn(shape, generator=generator)) for view in shown])
    found = transforms(light)
    assert torch.allclose(found.mean(dim=0), IDENTITY[kind], atol=1e-6)
    assert not torch.allclose(found, IDENTITY[kind].expand_as(found), atol=1e-3)
    assert kind != "exposure" or torch.equal(found * torch.eye(3, 4), found)


def test_gradients_that_are_no_numbers_change_nothing():
    light = Light("affine", range(2))
    light.step([(0, torch.full((3, 4), torch.nan))])
    assert torch.equal(transforms(light), torch.eye(3, 4).expand(2, 3, 4))


def test_layers_and_cuts_are_those_of_a_run_without_it(make):
    """Layers, crops and transmittances know nothing of a transform: it is of the finished picture."""
    drawn = []
    for kind in ("none", "affine"):
        made = make(kind, light=kind)
        batch = made.next_batch()
        if kind == "affine":
            made.run.light._changes += 0.1 * torch.randn(6, 3, 4, generator=torch.Generator().manual_seed(3))
        rendered = made.render(batch)
        drawn.append(list(zip(batch.samples, rendered.pictures, rendered.transmittances, strict=True)))
    for (one, plain, alone), (other, changed, same) in zip(*drawn, strict=True):
        assert one.crop == other.crop
        assert torch.equal(alone, same)
        for side in ("front", "back"):
            a, b = getattr(one.layers, side), getattr(other.layers, side)
            assert torch.equal(a.color, b.color)
            assert torch.equal(a.transmittance, b.transmittance)
        whole = ((plain > 0) & (plain < 1)).all(dim=-1)  # the others were clamped
        expected = lit(plain, made.run.light.of(other.view.index), other.crop, other.view).clamp(0, 1)
        assert whole.any()
        assert torch.allclose(changed[whole], expected[whole], atol=1e-6)
        assert not torch.allclose(changed, plain, atol=1e-2)


@pytest.mark.parametrize(("blocks", "steps", "kind"), [(1, 80, "affine"), (4, 120, "exposure")])
def test_drifting_light_costs_next_to_nothing_once_it_is_compensated(
    error, ring, drifting, blocks, steps, kind
):
    options = {"blocks": blocks, "steps": steps}
    steady = error("steady", Photos(TRUTH, ring), "none", **options)
    cost = error("drift", drifting, "none", **options) - steady
    left = error("compensated", drifting, kind, **options) - steady
    assert cost > steady
    assert left < 0.5 * cost


@pytest.mark.parametrize(("blocks", "steps"), [(1, 200), (4, 120)])
def test_grids_make_good_for_light_that_differs_within_a_photo(error, ring, blocks, steps):
    """A matrix for each photo cannot."""
    options, shaded = {"blocks": blocks, "steps": steps}, Shaded(TRUTH, ring)
    steady = error("steady", Photos(TRUTH, ring), "none", **options)
    cost = error("shaded", shaded, "none", **options) - steady
    with_matrices = error("matrices", shaded, "affine", **options) - steady
    with_grids = error("grids", shaded, "bilateral", **options) - steady
    assert cost > steady
    assert with_matrices > 0.9 * cost
    assert with_grids < 0.7 * cost


def test_a_part_of_a_picture_has_its_part_of_the_grid(ring):
    """And a reduced picture has the same at the same places."""
    generator = torch.Generator().manual_seed(0)
    grid = IDENTITY["bilateral"] + 0.2 * torch.randn(IDENTITY["bilateral"].shape, generator=generator)
    view, part = ring[0], Crop(16, 8, 21, 13)
    picture = torch.rand(view.height, view.width, 3, generator=generator)
    whole = lit(picture, grid, view.full, view)
    assert torch.allclose(lit(picture[part.slices], grid, part, view), whole[part.slices], atol=1e-6)
    assert not torch.allclose(lit(picture[part.slices], grid, part.within(part), view), whole[part.slices])
    *_, rows, columns = bilateral_grid.SHAPE
    slope = torch.linspace(0, 1, rows)[:, None] + torch.linspace(0, 0.5, columns)
    flat, half = torch.full_like(picture, 0.4), view.reduced(2)
    of_half = lit(flat[::2, ::2], slope * IDENTITY["bilateral"], half.full, half)
    of_whole = lit(flat, slope * IDENTITY["bilateral"], view.full, view)
    of_squares = of_whole.unflatten(0, (-1, 2)).unflatten(2, (-1, 2)).mean(dim=(1, 3))
    assert torch.allclose(of_half, of_squares, atol=1e-6)
    assert float(of_half.max() - of_half.min()) > 0.4


def test_a_grid_is_read_between_its_transforms(ring):
    """As a loop over pixels reads it, linearly, from the eight around a place."""
    generator, view = torch.Generator().manual_seed(1), ring[0]
    grid = torch.randn(12, *bilateral_grid.SHAPE, generator=generator, dtype=torch.float64)
    picture = torch.rand(view.height, view.width, 3, generator=generator, dtype=torch.float64)
    found = lit(picture, grid, view.full, view)
    for row, column in ((0, 0), (17, 23), (35, 47), (9, 40)):
        color = picture[row, column]
        luma = 0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]
        place = (float(luma), (row + 0.5) / view.height, (column + 0.5) / view.width)
        matrix = torch.zeros(12, dtype=torch.float64)
        at = [share * (size - 1) for share, size in zip(place, bilateral_grid.SHAPE, strict=True)]
        for corner in range(8):
            cell = [int(a) + (corner >> k & 1) for k, a in enumerate(at)]
            weight = 1.0
            for k, a in enumerate(at):
                weight *= 1 - abs(a - cell[k])
            if weight > 0:
                matrix += weight * grid[:, cell[0], cell[1], cell[2]]
        matrix = matrix.view(3, 4)
        assert torch.allclose(found[row, column], matrix[:, :3] @ color + matrix[:, 3], atol=1e-12)


def test_grids_are_held_smooth_by_what_a_picture_is_of_its_whole():
    grid = torch.randn(12, *bilateral_grid.SHAPE, generator=torch.Generator().manual_seed(2))
    variation = sum(float((grid.diff(dim=dim) ** 2).mean()) for dim in (1, 2, 3))
    assert float(bilateral_grid.total_variation(grid)) == pytest.approx(variation)
    leaf = grid.clone().requires_grad_()
    leaf.grad = torch.zeros_like(leaf)
    ((view, gradient),) = gradients_of([Use(3, leaf, weight=0.25)])
    assert view == 3
    step = 1e-3 * gradient / gradient.norm()
    fell = bilateral_grid.total_variation(grid) - bilateral_grid.total_variation(grid - step)
    expected = 10 * 0.25 * float(fell) / 1e-3
    assert float(gradient.norm()) == pytest.approx(expected, rel=1e-2)


def test_a_step_changes_and_a_commit_writes_the_grids_of_its_views_alone():
    light = Light("bilateral", range(40))
    light.step([(7, torch.ones(12, *bilateral_grid.SHAPE)), (31, torch.ones(12, *bilateral_grid.SHAPE))])
    assert sorted(light.changed()) == ["light-0", "light-31", "light-7"]  # the first has what all share
    assert light.changed() == {}
    assert sorted(Light("affine", range(40)).changed()) == []
    small = Light("affine", range(40))
    small.step([(39, torch.ones(3, 4))])
    assert sorted(small.changed()) == ["light-0"]


def test_a_run_goes_on_with_its_own_kind_of_light_alone(make, drifting):
    made = make("run", steps=12, light="affine")
    train(made, drifting, steps=6)
    made.save()
    made.scene.store.close()
    with pytest.raises(UserError, match=r"begun with --pipeline\.training\.light affine"):
        make("run", steps=12, light="bilateral", resume=True)


@pytest.mark.parametrize("kind", ["affine", "bilateral"])
@pytest.mark.parametrize("blocks", [1, 4])
def test_a_run_that_stops_goes_on_with_its_transforms_and_moments(make, drifting, blocks, kind):
    options = {"blocks": blocks, "steps": 30, "light": kind}
    whole, stopped = make("whole", **options), make("stopped", **options)
    train(whole, drifting)
    train(stopped, drifting, steps=14)
    stopped.save()
    stopped.scene.store.close()
    went_on = make("stopped", resume=True, **options)
    assert torch.equal(transforms(went_on.run.light), transforms(stopped.run.light))
    train(went_on, drifting)
    assert torch.equal(transforms(went_on.run.light), transforms(whole.run.light))
    assert not torch.equal(transforms(whole.run.light), transforms(stopped.run.light))
    for name in PARAM_NAMES:
        assert torch.equal(getattr(whole_scene(went_on), name), getattr(whole_scene(whole), name)), name


def test_joint_training_over_blocks_refuses_it():
    with pytest.raises(UserError, match=r"training\.light"):
        training_config(exact=True, light="affine").check()
