"""Normal consistency of 2DGS (Huang et al. 2024, eq. 14): surfels lie in the surface that they make.

Whatever colours c_i are drawn, a pixel has sum_i w_i c_i of them. In the colours q_i, the vectors of the
surfels' planes {x: <q_i, x> = 1} in the camera's frame, that is the mean plane of what it shows; and since a
ray r = K^-1 (x, y, 1) meets plane i at the depth 1 / <q_i, r>,

    z = A / <sum_i w_i q_i, r>,    A = sum_i w_i

is where the pixel's fragments are, in the harmonic mean: on their discs, not at the middles of these. With n
the normal of the mean plane and N that of the surface through the points z r of neighbouring pixels,

    L_n = A (1 - <n, N>).

Of a block between its layers A is T_F times what is drawn: the block, and what is sorted in with it.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.layers.surface import normals_of
from abcd_ns.engine.render import Rasterizer
from abcd_ns.engine.render import surfel_kernels as rows
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.train.step.batch import Sample
from abcd_ns.engine.transfer import upload
from abcd_ns.engine.types import Crop, Gaussians, View

BEGINS = 7 / 30
"""Share of the run, as in 2DGS: before, depths are no surface."""
COVERED = 0.5
"""Pixels of which no more than this is covered, as they are drawn, have no surface."""
GRAZING = 0.1
"""Planes seen under a smaller angle count as seen under this one, the sine of 6 degrees: what lies far beside
a disc on its plane has nothing to do with it."""


def normal_consistency(
    gaussians: Gaussians, samples: Sequence[Sample], rasterizer: Rasterizer
) -> Float[Tensor, ""]:
    """The mean over the samples of L_n, each as its crop's part of the whole image's mean over pixels.

    Args:
        gaussians: surfels.
    """
    found = [_of_sample(gaussians, sample, rasterizer) for sample in samples]
    return sum(found[1:], start=found[0]) / len(found)


def _of_sample(gaussians: Gaussians, sample: Sample, rasterizer: Rasterizer) -> Float[Tensor, ""]:
    alpha, planes = _mean_planes(gaussians, sample, rasterizer)
    facing, known = surface_normals(alpha, planes, sample.crop, sample.view)
    inner = slice(1, -1), slice(1, -1)
    off = alpha[inner] + (F.normalize(planes[inner], dim=-1) * facing).sum(dim=-1) * alpha[inner]
    shown = known if sample.in_front is None else known * sample.in_front[inner]
    return (off * shown).sum() / sample.view.full.pixels / sample.share


def _mean_planes(
    gaussians: Gaussians, sample: Sample, rasterizer: Rasterizer
) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w 3"]]:
    """A and sum w q of each pixel: one drawing, in the colours 1/2 + scale q, which none is clamped in."""
    view, shot = sample.view, sample.shot
    view = replace(view, viewmat=upload(view.viewmat, gaussians.means.device))
    own = planes_of(gaussians, view)
    scale = 0.5 / own.detach().abs().amax().clamp_min(1e-6) if len(own) else own.new_tensor(1.0)
    if shot.frozen is not None and len(shot.frozen):
        others = planes_seen(shot.frozen, view)
        scale = torch.minimum(scale, 0.5 / others.abs().amax().clamp_min(1e-6))
        shot = replace(shot, frozen=shot.frozen.colored(0.5 + scale * others))
    of_degree_0 = gaussians.features_rest[:, :0]
    colored = replace(gaussians, features_dc=scale * own / SH_C0, features_rest=of_degree_0)
    (raster,) = rasterizer.draw(colored, [shot], sh_degree=0)
    alpha = 1 - raster.transmittance
    return alpha, (raster.color - 0.5 * alpha[..., None]) / scale


def planes_of(gaussians: Gaussians, view: View) -> Float[Tensor, "n 3"]:
    """q of surfels, in the view's frame; 0 of those that it does not draw."""
    turn, center = view.viewmat[:3, :3].to(gaussians.means), view.center.to(gaussians.means)
    offsets = (gaussians.means - center) @ turn.T
    planes = _planes(normals_of(gaussians, center, flat=True) @ turn.T, offsets)
    return torch.where(offsets[:, 2:] >= view.near, planes, 0.0)


def planes_seen(splats: Splats, view: View) -> Float[Tensor, "n 3"]:
    """The same of surfels as the view sees them.

    Tangents are K^-1 (A, C, E) and K^-1 (B, D, F), see surfel_kernels; K^-1 a x K^-1 b is along K^T (a x b).
    """
    u, v, a, b, c, d, e, f = splats.planes[rows.U : rows.F + 1]
    x, y, z = c * f - d * e, b * e - a * f, a * d - b * c
    fx, fy, cx, cy = _pinhole(view)
    normals = F.normalize(torch.stack((fx * x, fy * y, cx * x + cy * y + z), dim=1), dim=1)
    slopes = torch.stack(((u - cx) / fx, (v - cy) / fy, torch.ones_like(u)), dim=1)
    return torch.where((splats.radii > 0)[:, None], _planes(normals, slopes * splats.depths[:, None]), 0.0)


def _planes(normals: Float[Tensor, "n 3"], offsets: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    away = (normals * offsets).sum(dim=1, keepdim=True)
    least = GRAZING * offsets.norm(dim=1, keepdim=True)
    return normals * away.sign() / away.abs().maximum(least).clamp_min(1e-9)


def surface_normals(
    alpha: Float[Tensor, "h w"], planes: Float[Tensor, "h w 3"], crop: Crop, view: View
) -> tuple[Float[Tensor, "_h _w 3"], Bool[Tensor, "_h _w"]]:
    """N of all pixels but the outermost, towards the camera and in its frame, by the differences of those on
    both sides; and where they are known."""
    fx, fy, cx, cy = _pinhole(view)
    x = (torch.arange(crop.width, device=alpha.device) + (crop.x + 0.5 - cx)) / fx
    y = (torch.arange(crop.height, device=alpha.device) + (crop.y + 0.5 - cy)) / fy
    per_depth = planes[..., 0] * x + planes[..., 1] * y[:, None] + planes[..., 2]
    is_there = (alpha.detach() > COVERED) & (per_depth.detach() > 0)
    depth = torch.where(is_there, alpha, 1.0) / torch.where(is_there, per_depth, 1.0)
    points = torch.stack((x * depth, y[:, None] * depth, depth), dim=-1)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    beside = is_there[1:-1, 2:] & is_there[1:-1, :-2] & is_there[2:, 1:-1] & is_there[:-2, 1:-1]
    return F.normalize(torch.linalg.cross(down, right), dim=-1), is_there[1:-1, 1:-1] & beside


def _pinhole(view: View) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy: numbers, since views are on the CPU."""
    fx, _, cx, _, fy, cy = view.K.flatten()[:6].tolist()
    return fx, fy, cx, cy
