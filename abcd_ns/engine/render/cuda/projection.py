"""Gaussians as several cameras see them, in gsplat's shapes, and these cameras on the device."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from gsplat.cuda._wrapper import (
    fully_fused_projection,
    fully_fused_projection_2dgs,
    rasterize_to_pixels,
    rasterize_to_pixels_2dgs,
    spherical_harmonics,
)
from jaxtyping import Bool, Float, Int, Int64
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.render.cuda import fused
from abcd_ns.engine.render.projection import PrimitiveName, Splats, check_degree
from abcd_ns.engine.types import Crop, Gaussians, View

KEPT = 1 << 14
"""Small tensors of a kind that are kept on the device: steps would otherwise upload them again and again."""


def poses(
    views: Sequence[View], like: Tensor
) -> tuple[Float[Tensor, "c 4 4"], Float[Tensor, "c 3 3"], Float[Tensor, "c 3"]]:
    """World to camera, intrinsics, and centres in world space. Those that take gradients are not kept."""
    if any(view.viewmat.requires_grad for view in views):
        packed = torch.stack([_packed(view) for view in views]).to(like)
    else:
        packed = _stacked([_kept_pose(view, like.device, like.dtype) for view in views])
    return packed[:, :16].view(-1, 4, 4), packed[:, 16:25].view(-1, 3, 3), packed[:, 25:]


def corners(crops: Sequence[Crop], like: Tensor) -> Float[Tensor, "c 2"]:
    """(x, y) of upper left corners; written there by the device, so nothing is copied."""
    return _stacked([_kept_corner(crop.x, crop.y, like.device, like.dtype) for crop in crops])


@lru_cache(maxsize=1)
def numbers(cameras: int, n: int, device: torch.device) -> Int64[Tensor, "m"]:
    """0 to `cameras` less 1, n times each; the last are kept."""
    with torch.inference_mode(False):  # they outlive this call
        each = torch.arange(cameras, device=device)[:, None].expand(-1, n)
        return each.reshape(-1).contiguous()


def _packed(view: View) -> Float[Tensor, "28"]:
    """Both matrices of a view, and its centre."""
    return torch.cat((view.viewmat.flatten(), view.K.flatten(), view.center))


@lru_cache(maxsize=KEPT)
def _kept_pose(view: View, device: torch.device, dtype: torch.dtype) -> Float[Tensor, "28"]:
    """Views are known by the identity of their matrices."""
    with torch.inference_mode(False), torch.no_grad():  # they outlive this call
        return _packed(view).to(device, dtype, non_blocking=True)


@lru_cache(maxsize=KEPT)
def _kept_corner(x: int, y: int, device: torch.device, dtype: torch.dtype) -> Float[Tensor, "2"]:
    with torch.inference_mode(False), torch.no_grad():  # they outlive this call
        return torch.stack([torch.full((), at, device=device, dtype=dtype) for at in (x, y)])


OnScreen = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor | None]
"""radii, means2d, depths, shapes and centers as in Projected, and compensations of opacities."""


class Kind(NamedTuple):
    """A primitive's three functions."""

    shape: int
    """Numbers of a shape."""
    place: Callable[..., OnScreen]
    """Gaussians in the images of cameras: world to camera, and intrinsics; whether opacities are compensated;
    and the images' size and near plane, as in gsplat's `fully_fused_projection`."""
    moved: Callable[[Tensor, Tensor], Tensor]
    """Shapes [m, s] where pixels are counted from another corner, [2] or [m, 2]."""
    draw: Callable[..., tuple[Tensor, Tensor]]
    """Features and alphas of means2d, shapes, features and opacities; the rest as in gsplat's
    `rasterize_to_pixels`."""


def _place_splats(
    gaussians: Gaussians, cameras: tuple[Tensor, Tensor], antialiased: bool, **image: Any
) -> OnScreen:
    """Shapes are conics."""
    places = gaussians.means, None, gaussians.quats, gaussians.scales.exp()
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        *places, *cameras, **image, calc_compensations=antialiased
    )
    return radii, means2d, depths, conics, means2d, compensations


def _place_surfels(
    gaussians: Gaussians, cameras: tuple[Tensor, Tensor], _antialiased: bool, **image: Any
) -> OnScreen:
    """Shapes are the center and the matrix of `surfel`, (u, v, A, B, C, D, E, F).

    The boxes' middles are found anew: gsplat's own gradient of theirs lacks some terms.
    """
    places = gaussians.means, gaussians.quats, gaussians.scales.exp()
    radii, _, depths, rays, _ = fully_fused_projection_2dgs(*places, *cameras, **image)
    matrix = rays / rays[..., 2:, 2:]
    centers = matrix[..., :2, 2]
    (a, b), (c, d), (e, f) = (matrix[..., row, :2].unbind(-1) for row in range(3))
    u, v = matrix[..., :2, 2].unbind(-1)  # anew: these are no part of what `centers` gets as its gradient
    distance = e * e + f * f - 1
    off = ((a - u * e) * e + (b - u * f) * f, (c - v * e) * e + (d - v * f) * f)
    means2d = torch.stack((u + off[0] / distance, v + off[1] / distance), dim=-1)
    shapes = torch.cat((centers, torch.stack((a, b, c, d, e, f), dim=-1)), dim=-1)
    return radii, means2d, depths, shapes, centers, None


def _moved_surfels(shapes: Float[Tensor, "m 8"], by: Float[Tensor, "*m 2"]) -> Float[Tensor, "m 8"]:
    x, y = by[..., :1], by[..., 1:]
    center, across, down, away = shapes.split(2, dim=-1)
    return torch.cat((center - by, across - x * away, down - y * away, away), dim=-1)


def _draw_surfels(
    means2d: Tensor, shapes: Tensor, features: Tensor, opacities: Tensor, *lists: Any, **options: Any
) -> tuple[Tensor, Tensor]:
    """gsplat's absolute gradients are of its low-pass filter alone, so nobody asks for them."""
    u, v, a, b, c, d, e, f = shapes.unbind(-1)
    rays = torch.stack((a, b, u, c, d, v, e, f, torch.ones_like(u)), dim=-1).view(-1, 3, 3)
    normals, densify = features.new_zeros((len(features), 3)), torch.zeros_like(means2d)
    drawn = rasterize_to_pixels_2dgs(means2d, rays, features, opacities, normals, densify, *lists, **options)
    return drawn[0], drawn[1]


def kind_of(primitive: PrimitiveName) -> Kind:
    """The functions of a primitive."""
    if primitive == "2dgs":
        return Kind(8, _place_surfels, _moved_surfels, _draw_surfels)
    return Kind(3, _place_splats, lambda shapes, _: shapes, rasterize_to_pixels)


@dataclass(frozen=True)
class Projected:
    """n Gaussians in each of c cameras of one image size and near plane; pixels of the full images."""

    radii: Int[Tensor, "c n"]
    """0 where nothing is drawn; nothing else is initialised there."""
    means2d: Float[Tensor, "c n 2"]
    depths: Float[Tensor, "c n"]
    shapes: Float[Tensor, "c n s"]
    """See Splats."""
    opacities: Float[Tensor, "c n"]
    features: Float[Tensor, "c n 4"]
    """Colour, then depth: what is composited."""
    centers: Float[Tensor, "c n 2"]
    """Where their middles are; by whose gradient they grow."""
    weights: Float[Tensor, "c n"]
    """What gets the gradient of the depths that are composited."""

    @staticmethod
    def nothing(cameras: int, shape: int, gaussians: Gaussians) -> "Projected":
        """No Gaussian, of whose shape there would be so many numbers. In the graph like any other, so that a
        loss has a gradient."""
        centers = gaussians.means[:, :2].expand(cameras, -1, -1)
        features, shapes = (centers.new_zeros((cameras, 0, k)) for k in (4, shape))
        depths = centers[..., 0]
        return Projected(depths.int(), centers, depths, shapes, depths, features, centers, depths)

    def splats(self, camera: int, which: Int[Tensor, "k"] | None = None) -> Splats:
        """As one of the cameras sees them, or these of them."""
        values = (self.means2d, self.depths, self.shapes, self.opacities, self.features[..., :3], self.radii)
        of_one = (value[camera] for value in values)
        chosen = (value if which is None else value.index_select(0, which) for value in of_one)
        each = (value if value.dim() == 2 else value[:, None] for value in chosen)
        *rows, radii = (value.to(self.depths).T for value in each)
        bounds = radii.new_zeros((3, radii.shape[1]))  # as the CPU has them
        return Splats(torch.cat((*rows, bounds, radii)))


def place_on_screen(
    kind: Kind, gaussians: Gaussians, views: Sequence[View], antialiased: bool = False
) -> tuple[OnScreen, Float[Tensor, "c 3"]]:
    """Where views see Gaussians, and the views' centres in world space."""
    *matrices, centers = poses(views, gaussians.means)
    like = views[0]
    image = {"width": like.width, "height": like.height, "near_plane": like.near, "packed": False}
    return kind.place(gaussians, tuple(matrices), antialiased, **image), centers


def project(
    kind: Kind,
    gaussians: Gaussians,
    views: Sequence[View],
    sh_degree: int,
    antialiased: bool,
    blend_weights: bool = False,
) -> Projected:
    """The first half of gsplat's `rasterization(packed=False)`, for the full images of views of one size and
    near plane; `blend_weights` gives zeros for the depths that are composited."""
    check_degree(gaussians, sh_degree)
    if len(gaussians) == 0:  # of which gsplat's kernels are not asked
        return Projected.nothing(len(views), kind.shape, gaussians)
    placed, eyes = place_on_screen(kind, gaussians, views, antialiased)
    radii, means2d, depths, shapes, centers, compensations = placed
    opacities = gaussians.opacities.flatten().sigmoid()
    opacities = opacities[None] if len(views) == 1 else opacities.expand(len(views), -1)
    if compensations is not None:
        opacities = opacities * compensations
    weights = depths.detach().requires_grad_() if blend_weights else depths
    coefficients = gaussians.features_dc, gaussians.features_rest
    features = _Features.apply(gaussians.means, eyes, *coefficients, weights, radii, sh_degree, blend_weights)
    return Projected(radii, means2d, depths, shapes, opacities, features, centers, weights)


class _Features(torch.autograd.Function):
    """Colours by spherical harmonics, 0 or more, and another number, side by side; gsplat's kernels apart, a
    handful of operations, of which autograd would make twice as many.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Float[Tensor, "n 3"],
        eyes: Float[Tensor, "c 3"],
        features_dc: Float[Tensor, "n 3"],
        features_rest: Float[Tensor, "n k 3"],
        last: Float[Tensor, "c n"],
        radii: Int[Tensor, "c n"],
        sh_degree: int,
        blend_weights: bool,
    ) -> Float[Tensor, "c n 4"]:
        # All, whatever the degree: gsplat's kernels read those of it alone.
        coefficients = torch.cat((features_dc[:, None], features_rest), dim=1)
        *directions, coefficients = leaves = [*(means - eyes[:, None]).unbind(), coefficients]
        if any(ctx.needs_input_grad):
            leaves = [value.requires_grad_() for value in leaves]
        # Camera by camera: for all at once gsplat would copy the coefficients, most of a Gaussian, for each.
        with torch.set_grad_enabled(any(ctx.needs_input_grad)):
            seen = zip(directions, (radii > 0).unbind(), strict=True)
            colors = [spherical_harmonics(sh_degree, d, coefficients, masks=m) for d, m in seen]
        ctx.graph = leaves, colors
        drawn = _stacked([color.detach() for color in colors])
        features, dark = _shaded(drawn, None if blend_weights else last)
        ctx.save_for_backward(dark)
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Float[Tensor, "c n 4"]) -> tuple[Tensor | None, ...]:
        (dark,), (leaves, colors) = ctx.saved_tensors, ctx.graph
        ctx.graph = None  # else it would last as long as what was drawn
        upstream = grad[..., :3].masked_fill(dark, 0.0)
        found = torch.autograd.grad(colors, leaves, upstream.unbind(), materialize_grads=True)
        directions, coefficients = _stacked(found[:-1]), found[-1]
        by_means = directions[0] if len(directions) == 1 else directions.sum(dim=0)
        by_eyes = -directions.sum(dim=1) if ctx.needs_input_grad[1] else None
        return by_means, by_eyes, coefficients[:, 0], coefficients[:, 1:], grad[..., 3], None, None, None


def _shaded(
    colors: Float[Tensor, "c n 3"], depths: Float[Tensor, "c n"] | None
) -> tuple[Float[Tensor, "c n 4"], Bool[Tensor, "c n 3"]]:
    """See `shade`."""
    found = fused.shade(colors, depths)
    if found is not None:
        return found
    lighter = colors + 0.5
    last = torch.zeros_like(colors[..., 0]) if depths is None else depths
    return torch.cat((lighter.clamp_min(0.0), last[..., None]), dim=-1), lighter < 0


def _stacked(values: Sequence[Tensor]) -> Tensor:
    """`torch.stack`, which copies nothing where there is one."""
    return values[0][None] if len(values) == 1 else torch.stack(tuple(values))
