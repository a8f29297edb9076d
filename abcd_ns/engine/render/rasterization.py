"""gsplat 1.4.0's `rasterization` on any device: this package's rasterizers behind gsplat's signature."""

import functools
from collections.abc import Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.render import PrimitiveName, Raster, Rasterizer, Shot, TorchRasterizer, make_rasterizer
from abcd_ns.engine.render.cpu.backend import NO_ABSGRAD
from abcd_ns.engine.types import Gaussians, View

FIXED = {
    "far_plane": 1e10,
    "radius_clip": 0.0,
    "eps2d": 0.3,
    "packed": False,
    "tile_size": 16,
    "sparse_grad": False,
    "channel_chunk": 32,
    "distributed": False,
    "camera_model": "pinhole",
    "covars": None,
}
"""gsplat's other arguments and the one value that each may have: gsplat's default, but for `packed`."""
WORDS = {
    "render_mode": ("RGB", "D", "ED", "RGB+D", "RGB+ED"),
    "rasterize_mode": ("classic", "antialiased"),
}
LEAST_COLOR, LEAST_SCALE, LEAST_OPACITY = 0.01, 1e-30, 1e-7
"""Gaussians are kept before activation, which maps 0 to infinity."""


@functools.cache
def rasterizer_on(device: torch.device, primitive: PrimitiveName = "3dgs") -> Rasterizer:
    """The one rasterizer of a device, made and checked at the first call."""
    return make_rasterizer("auto", device, primitive=primitive)


def rasterization(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    colors: Float[Tensor, "n 3"] | Float[Tensor, "n k 3"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    sh_degree: int | None = None,
    backgrounds: Float[Tensor, "c _d"] | None = None,
    render_mode: Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"] = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    absgrad: bool = False,
    **fixed: Any,
) -> tuple[Float[Tensor, "c height width d"], Float[Tensor, "c height width 1"], dict[str, Any]]:
    """Draw Gaussians by pinhole cameras, as gsplat 1.4.0's `rasterization(packed=False)` does.

    On a CPU by this package's kernels, on CUDA by gsplat's. Differentiable in the Gaussians.

    Args:
        means, scales: centres and standard deviations, world units.
        quats: rotations (w, x, y, z); need not be normalised.
        opacities: 0..1.
        colors: any numbers; with `sh_degree` the coefficients of spherical harmonics, k of 1, 4, 9 or 16.
        viewmats, Ks: world to camera, OpenCV convention; intrinsics in pixels.
        near_plane: Gaussians whose mean has a smaller camera z are not drawn; world units.
        sh_degree: in use; at most what k allows.
        backgrounds: behind the colours; depth has none.
        render_mode: D is the sum of weight x camera z, ED the same over alpha; the last channel.
        absgrad: after backward, `means2d.absgrad` sums each pixel's absolute gradient; on a CPU.
        fixed: see FIXED.

    Returns:
        Pictures, alphas, and of gsplat's `meta` what its densification strategies read: means2d [c, n, 2]
        (for its gradient call `retain_grad`), radii [c, n], width, height, n_cameras, gaussian_ids.

    Raises:
        ValueError: an argument has a value that is not supported.
        TypeError: gsplat has no such argument.
    """
    _check(colors, sh_degree, fixed, render_mode=render_mode, rasterize_mode=rasterize_mode)
    _check_cameras(viewmats, Ks, backgrounds)
    gaussians, lift = _before_activation(means, quats, scales, opacities, colors)
    cameras = zip(viewmats.cpu(), Ks.cpu(), strict=True)
    views = [View(pose, K, width, height, k, near_plane) for k, (pose, K) in enumerate(cameras)]
    options = {"sh_degree": sh_degree or 0, "antialiased": rasterize_mode == "antialiased"}
    rasters = _draw(gaussians, views, **options, **({"absgrad": True} if absgrad else {}))
    alphas = torch.stack([1 - raster.transmittance[..., None] for raster in rasters])
    color = torch.stack([raster.color for raster in rasters]) - lift * alphas
    if backgrounds is not None:
        color = color + (1 - alphas) * backgrounds[:, None, None]
    depth = torch.stack([raster.depth[..., None] for raster in rasters])
    depth = depth / alphas.clamp_min(1e-10) if "ED" in render_mode else depth
    wanted = [color] * ("RGB" in render_mode) + [depth] * ("D" in render_mode)
    sizes = {"width": width, "height": height, "n_cameras": len(views), "gaussian_ids": None}
    return torch.cat(wanted, dim=-1), alphas, rasters[0].info | sizes


def _draw(gaussians: Gaussians, views: Sequence[View], **options: Any) -> tuple[Raster, ...]:
    rasterizer = rasterizer_on(gaussians.means.device)
    if "absgrad" in options and not isinstance(rasterizer, TorchRasterizer):
        raise ValueError(NO_ABSGRAD)
    return rasterizer.draw(gaussians, [Shot(view, view.full) for view in views], **options)


def _check(colors: Tensor, sh_degree: int | None, fixed: dict[str, Any], **words: str) -> None:
    for name, value in fixed.items():
        if name not in FIXED:
            raise TypeError(f"rasterization has no argument {name}.")
        if value != FIXED[name]:
            raise ValueError(f"{name}={value} is not supported here: leave it out.")
    for name, value in words.items():
        if value not in WORDS[name]:
            raise ValueError(f"{name} must be one of {', '.join(WORDS[name])}, not {value}.")
    if colors.shape[-1] != 3 or colors.ndim != (2 if sh_degree is None else 3):
        wanted = "[n, 3]" if sh_degree is None else "[n, k, 3]"
        raise ValueError(f"colors must be {wanted}, not {list(colors.shape)}.")


def _check_cameras(viewmats: Tensor, Ks: Tensor, backgrounds: Tensor | None) -> None:
    wanted = {"viewmats": (viewmats, 4, 4), "Ks": (Ks, 3, 3)}
    wanted |= {} if backgrounds is None else {"backgrounds": (backgrounds, 3)}
    for name, (value, *size) in wanted.items():
        if list(value.shape) != [len(viewmats), *size]:
            raise ValueError(f"{name} must be {[len(viewmats), *size]}, not {list(value.shape)}.")


def _before_activation(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
) -> tuple[Gaussians, float]:
    """The Gaussians, and what was added to their colours.

    Raise ValueError unless there is one of each for each Gaussian, in one dtype and on one device: the native
    library reads memory by the means' number and type.
    """
    shapes = {"means": (means, 3), "quats": (quats, 4), "scales": (scales, 3), "opacities": (opacities,)}
    for name, (value, *size) in {**shapes, "colors": (colors, *colors.shape[1:])}.items():
        if list(value.shape) != [len(means), *size]:
            raise ValueError(f"{name} must be {[len(means), *size]}, not {list(value.shape)}.")
        if (value.dtype, value.device) != (means.dtype, means.device) or not value.is_floating_point():
            kind = f"{name} are {value.dtype} on {value.device}, and means {means.dtype} on {means.device}"
            raise ValueError(f"{kind}: give all as one floating-point type, on one device.")
    lift = 0.0
    if colors.ndim == 2:  # harmonics below 0 are drawn as 0 and have no gradient
        lift = max(0.0, LEAST_COLOR - float(colors.detach().min())) if len(colors) else 0.0
        colors = ((colors + lift - 0.5) / SH_C0)[:, None]
    made = Gaussians(
        means=means,
        scales=_between(scales, LEAST_SCALE, torch.inf).log(),
        quats=quats,
        features_dc=colors[:, 0],
        features_rest=colors[:, 1:],
        opacities=_between(opacities, LEAST_OPACITY, 1 - LEAST_OPACITY).logit()[:, None],
    )
    return made, lift


def _between(values: Tensor, least: float, most: float) -> Tensor:
    """Clamped, with the gradient of what is not clamped."""
    return values + (values.clamp(least, most) - values).detach()
