"""The stand-ins for gsplat's functions: signatures, lists, gradients, and one launch each on the device."""

import pytest
import torch
from gsplat.cuda import _torch_impl

from abcd_ns.engine import render
from abcd_ns.engine.render import TorchRasterizer, make_rasterizer, self_check
from abcd_ns.errors import UserError
from tests.reference import gsplat_stand_ins as stand_ins
from tests.reference.simulated_device import DEVICE, simulated_device

TILE, COLS, ROWS = 16, 5, 3
SIZE = COLS * TILE, ROWS * TILE


def projected(count: int = 30, channels: int = 4) -> dict[str, torch.Tensor]:
    """Faint splats in an image of 5 x 3 tiles, float64."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    return {
        "means2d": uniform(count, 2) * torch.tensor(SIZE),
        "conics": torch.cat(
            (0.01 + 0.05 * uniform(count, 1), 0.01 * uniform(count, 1), 0.01 + 0.05 * uniform(count, 1)),
            dim=1,
        ),
        "colors": uniform(count, channels),
        "opacities": 0.3 + 0.5 * uniform(count),
    }


def lists(splats, cameras=1, rows=ROWS):
    """Of the splats, dealt out to cameras."""
    count = len(splats["means2d"])
    radii = torch.full((count,), 20, dtype=torch.int32)
    radii[:2] = 0
    depths = 1 + torch.rand(count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    camera = torch.arange(cameras).repeat_interleave(count // cameras)
    args = splats["means2d"], radii, depths, TILE, COLS, rows
    return stand_ins.isect_tiles(
        *args, packed=True, n_cameras=cameras, camera_ids=camera, gaussian_ids=camera
    ), args


def drawn(splats, offsets, ids, **options):
    return stand_ins.rasterize_to_pixels(*splats.values(), *SIZE, TILE, offsets, ids, packed=True, **options)


@pytest.mark.parametrize("cameras", [1, 2, 3])
def test_lists_are_gsplats(cameras):
    found, args = lists(projected(), cameras)
    means2d, radii, depths = (x.view(cameras, 30 // cameras, *x.shape[1:]) for x in args[:3])
    expected = _torch_impl._isect_tiles(means2d.float(), radii, depths.float(), *args[3:])
    assert torch.equal(found[0].view(cameras, -1), expected[0])
    assert all(torch.equal(a, b) for a, b in zip(found[1:], expected[1:], strict=True))
    kept = found[1][::3]
    encoded = stand_ins.isect_offset_encode(kept, cameras, COLS, ROWS)
    assert torch.equal(encoded, _torch_impl._isect_offset_encode(kept, cameras, COLS, ROWS))
    nothing = stand_ins.isect_offset_encode(kept[:0], cameras, COLS, ROWS)
    assert nothing.shape == (cameras, ROWS, COLS)
    assert not nothing.any()


def test_what_is_masked_or_beyond_the_picture_is_not_drawn():
    """As in the kernels: the last list ends where the pairs do, tiles below the picture show nothing, and of
    a masked tile the alphas are not even written."""
    splats = {name: x.requires_grad_() for name, x in projected().items()}
    (_, ids, rows), _ = lists(splats, rows=ROWS + 1)
    offsets = stand_ins.isect_offset_encode(ids, 1, COLS, ROWS + 1)
    tail = torch.cat((rows, torch.zeros(500, dtype=torch.int32)))
    masks = torch.ones(1, ROWS + 1, COLS, dtype=torch.bool)
    masks[0, 1, 2] = False
    color, alpha = drawn(splats, offsets, tail, masks=masks)
    whole, through = drawn(splats, offsets, rows)
    hidden = torch.zeros(1, SIZE[1], SIZE[0], 1, dtype=torch.bool)
    hidden[:, TILE : 2 * TILE, 2 * TILE : 3 * TILE] = True
    assert torch.equal(alpha.isnan(), hidden)
    torch.testing.assert_close(torch.where(hidden, whole, color), whole)
    torch.testing.assert_close(torch.where(hidden, through, alpha), through)
    assert not color[hidden.expand_as(color)].any()
    (gradient,) = torch.autograd.grad(color.sum(), splats["opacities"])
    (expected,) = torch.autograd.grad(torch.where(hidden, 0.0, whole).sum(), splats["opacities"])
    torch.testing.assert_close(gradient, expected)


@pytest.mark.parametrize(("primitive", "name"), [("3dgs", "gsplat"), ("2dgs", "surfel-gsplat")])
def test_auto_is_gsplat_on_the_simulated_device_and_agrees_with_torch(primitive, name):
    with simulated_device(), stand_ins.lent():
        rasterizer = make_rasterizer("auto", DEVICE, primitive=primitive)
        assert rasterizer.name.startswith(name)
        assert 0 < self_check(rasterizer, DEVICE) < (1e-4 if primitive == "3dgs" else 5e-4)
        assert make_rasterizer("torch", DEVICE).name.startswith("torch")


def test_where_gsplat_has_no_kernels_one_line_says_so(monkeypatch):
    monkeypatch.setattr(render, "self_check", lambda *_: None.CameraModelType)
    with pytest.raises(UserError, match=r"put nvcc on the PATH.*rasterizer torch"):
        make_rasterizer("auto", DEVICE)
    monkeypatch.setattr(render, "self_check", lambda *_: TorchRasterizer.missing)
    with pytest.raises(AttributeError, match="missing"):
        make_rasterizer("auto", DEVICE)
