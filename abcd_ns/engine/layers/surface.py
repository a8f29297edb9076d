"""What else than colour pictures of a scene tell: normals, median depth, and fog.

Fog is Gaussians between a camera and all that its photo is known to show. They imitate what differs from
photo to photo, as vignettes do, and veil other views. Nothing of this is drawn unless it is asked for.
"""

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.layers.layer_renderer import LayerRenderer, RenderSettings
from abcd_ns.engine.render import Raster
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.render.splat_kernels import own_axes
from abcd_ns.engine.types import Gaussians, View

UPRIGHT = 2
"""The axis of a surfel's normal; an ellipsoid's is that of its least scale."""
NEARER = 0.85
"""Of the view's nearest point: Gaussians with a smaller camera z are fog."""


def colored_by_normal(gaussians: Gaussians, view: View, flat: bool) -> Gaussians:
    """The same in the colours (n + 1) / 2, for unit normals across them, or across surfels if `flat`; world
    space, on the side of the view. Any rasterizer draws them, with harmonics of degree 0, and any layers
    fold; `normals_in` makes normals of the picture."""
    found = own_axes(*F.normalize(gaussians.quats, dim=1).unbind(1))
    axes = torch.stack([torch.stack(axis, dim=1) for axis in found], dim=1)
    which = gaussians.scales.argmin(dim=1)
    which = torch.full_like(which, UPRIGHT) if flat else which
    normals = axes[torch.arange(len(which), device=which.device), which]
    away = ((gaussians.means - view.center.to(gaussians.means)) * normals).sum(dim=1, keepdim=True)
    shown = torch.where(away > 0, -normals, normals) / (2 * SH_C0)
    return replace(gaussians, features_dc=shown, features_rest=torch.zeros_like(gaussians.features_rest))


def normals_in(raster: Raster) -> Float[Tensor, "h w 3"]:
    """Unit vectors: the mean normal of what each pixel shows, by weight; 0 where it shows nothing.

    With weights w_i and colours (n_i + 1) / 2, 2 C - (1 - T) is the sum of w_i n_i.
    """
    return F.normalize(2 * raster.color - (1 - raster.transmittance)[..., None], dim=-1)


def fog_in_white(gaussians: Gaussians, view: View) -> Gaussians:
    """The same with fog white and all else black: the mean of their picture, drawn with harmonics of degree 0
    before black, is the share of the screen that fog takes."""
    matrix = view.viewmat.to(gaussians.means)
    z = gaussians.means @ matrix[2, :3] + matrix[2, 3]
    white = torch.where(z < NEARER * view.nearest, 0.5, -0.5) / SH_C0
    dark = torch.zeros_like(gaussians.features_rest)
    return replace(gaussians, features_dc=white[:, None].expand(-1, 3).contiguous(), features_rest=dark)


@torch.no_grad()
def median_depth(renderer: LayerRenderer, view: View, settings: RenderSettings) -> Float[Tensor, "h w"]:
    """Camera z of the Gaussian at which half of each pixel is covered, world units: the last that is drawn
    while the transmittance is above a half, as in 2DGS (Huang et al. 2024) and gsplat's `render_median`; 0
    where nothing is.

    By the torch rasterizer, on whatever device: gsplat's kernels give it for surfels alone, and for all of a
    ray. Here a node goes on from the transmittance that those in front leave, so that any division by
    fragments gives the same.
    """
    rasterizer = renderer.rasterizer
    if not isinstance(rasterizer, TorchRasterizer):
        options = {"tile_side": rasterizer.tile_side, "primitive": rasterizer.primitive.name}
        rasterizer = TorchRasterizer(use_native=False, **options)
    like = {"device": renderer.device, "dtype": view.viewmat.dtype}
    left = torch.ones((view.height, view.width), **like)
    depth = torch.zeros_like(left)
    for node, gaussians in renderer.loaded_in_order(view):
        window = renderer.span(node, view, view.full) if node else None
        given = gaussians, view, window, (left, depth)
        left, depth = rasterizer.deepened(*given, antialiased=settings.antialiased)
        if float(left.max()) <= 0.5:
            break
    return depth
