from collections.abc import Callable

import torch
from torch import Tensor

from abcd_ns.engine.render import Raster, Rasterizer, Shot, ZWindow
from abcd_ns.engine.render.z_window import TileGrid
from abcd_ns.engine.types import PARAM_NAMES, Crop, Gaussians, Layer, View


def random_gaussians(
    n: int, seed: int = 0, sh_degree: int = 3, dtype: torch.dtype = torch.float64
) -> Gaussians:
    """Overlapping Gaussians in front of `small_view`, some of them beside the image."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = normal(n, 3) * torch.tensor([1.5, 1.0, 1.0]) + torch.tensor([0.0, 0.0, 4.0])
    rest = 0.3 * normal(n, (sh_degree + 1) ** 2 - 1, 3)
    gaussians = Gaussians(
        means, 0.7 * normal(n, 3) - 1.6, normal(n, 4), normal(n, 3), rest, 2 * normal(n, 1) + 1
    )
    return gaussians.to(dtype)


def small_view(width: int = 37, height: int = 21, dtype: torch.dtype = torch.float64) -> View:
    """A slightly turned camera; the image is no multiple of a tile, the principal point off its centre."""
    angle = torch.tensor(0.1, dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = angle.cos()
    viewmat[0, 2], viewmat[2, 0] = angle.sin(), -angle.sin()
    viewmat[:3, 3] = torch.tensor([-0.3, 0.1, 0.2])
    K = torch.tensor([[0.8 * width, 0, width / 2 + 1], [0, 1.3 * height, height / 2 - 1], [0, 0, 1]])
    return View(viewmat, K, width, height).to(dtype)


def random_window(grid: TileGrid, seed: int = 3, dtype: torch.dtype = torch.float64) -> ZWindow:
    """Another range of z in each tile; about one in ten is empty."""
    generator = torch.Generator().manual_seed(seed)
    near, size = torch.rand(2, grid.tiles, generator=generator, dtype=torch.float64)
    near, far = 4 * near + 1, 4 * near + 0.75 + 2.5 * size
    return ZWindow(grid, near.to(dtype), far.to(dtype))


def drawn(
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    view: View,
    *,
    crop: Crop | None = None,
    frozen: Gaussians | None = None,
    z_window: ZWindow | None = None,
    residual_sums: bool = False,
    **options,
) -> Raster:
    """One shot, beside what is frozen or in a window."""
    seen = None if frozen is None else rasterizer.project(frozen, view, **options)
    shot = Shot(view, crop or view.full, seen, z_window)
    return rasterizer.draw(gaussians, [shot], residual_sums=residual_sums, **options)[0]


def as_leaves(gaussians: Gaussians) -> Gaussians:
    """Copies that take gradients."""
    return Gaussians(**{name: value.detach().clone().requires_grad_() for name, value in gaussians.items()})


def probe(height: int, width: int, seed: int = 5, dtype: torch.dtype = torch.float64) -> Tensor:
    """Random weights [h, w, 5] for colour, transmittance and depth."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(height, width, 5, generator=generator, dtype=torch.float64).to(dtype)


def stacked(raster) -> Tensor:
    """All outputs as one image [h, w, 5]."""
    return torch.cat((raster.color, raster.transmittance[..., None], raster.depth[..., None]), dim=-1)


def gradients(draw: Callable[[Gaussians], object], gaussians: Gaussians) -> tuple[Tensor, dict[str, Tensor]]:
    """(stacked image, gradients by name) of a random weighting of all outputs of `draw`."""
    leaves = as_leaves(gaussians)
    image = stacked(draw(leaves))
    loss = (image * probe(*image.shape[:2], dtype=image.dtype).to(image.device)).sum()
    values = [getattr(leaves, name) for name in PARAM_NAMES]
    grads = torch.autograd.grad(loss, values, materialize_grads=True)
    return image.detach(), dict(zip(PARAM_NAMES, grads, strict=True))


def assert_drawn_alike(
    draw: Callable, oracle: Callable, gaussians: Gaussians, picture: float, gradient: float
) -> None:
    """Both draw the same, with the same gradients.

    Args:
        picture, gradient: how far off they may be, as a share of the largest value.
    """
    (image, found), (expected, wanted) = (gradients(each, gaussians) for each in (draw, oracle))
    assert relative_error(image, expected) < picture
    for name in PARAM_NAMES:
        assert relative_error(found[name], wanted[name]) < gradient, name


def assert_same_layer(found: Layer, expected: Layer, atol: float = 0.0) -> None:
    """To the last bit unless told otherwise."""
    for name in ("color", "transmittance"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=0.0, atol=atol)


def relative_error(value: Tensor, reference: Tensor) -> float:
    """The largest difference, as a share of the largest reference value."""
    return float((value - reference).abs().max() / reference.abs().max().clamp_min(1e-30))
