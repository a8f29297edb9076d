"""The slow twin of the rasterizers: textbook formulas, one pixel and one Gaussian at a time, in float64.

Written from the papers (EWA splatting; Kerbl et al. 2023; Huang et al. 2024) and gsplat 1.4.0's CUDA sources;
shares no code with the package. Differentiable by autograd.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from abcd_ns.engine.types import Crop, Gaussians, View


@dataclass
class NaiveRaster:
    color: Tensor
    transmittance: Tensor
    depth: Tensor
    means2d: Tensor
    """[n, 2], of `gaussians` alone; in the graph."""
    radii: list[int]


def rotation(quat: Tensor) -> Tensor:
    """By the cross-product form R v = v + 2 w (u x v) + 2 u x (u x v)."""
    quat = quat / quat.norm()
    w, u = quat[0], quat[1:]
    cross = torch.stack([torch.linalg.cross(u, e) for e in torch.eye(3, dtype=quat.dtype)], dim=1)
    return torch.eye(3, dtype=quat.dtype) + 2 * w * cross + 2 * cross @ cross


def sh_color(dc: Tensor, rest: Tensor, direction: Tensor, degree: int) -> Tensor:
    """The polynomials of the 3DGS reference, with its printed constants."""
    x, y, z = direction / direction.norm()
    bases = [
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z),
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    color = 0.28209479177387814 * dc
    for k in range((degree + 1) ** 2 - 1):
        color = color + bases[k] * rest[k]
    return torch.clamp_min(color + 0.5, 0.0)


@dataclass
class _Splat:
    mean: Tensor
    """The middle of the square that its tiles touch."""
    sigma: Callable[[Tensor], Tensor]
    """alpha = opacity exp(-sigma) at a pixel."""
    opacity: Tensor
    color: Tensor
    depth: Tensor
    radius: int
    windowed: bool


def _project(g: Gaussians, i: int, mean: Tensor, mean_c: Tensor, view: View, antialiased: bool) -> tuple:
    """(mean, sigma, opacity, radius) of the i-th Gaussian."""
    fx, fy, cx, cy = (float(view.K[r, c]) for r, c in ((0, 0), (1, 1), (0, 2), (1, 2)))
    x, y, z = mean_c
    pad_x, pad_y = 0.3 * 0.5 * view.width / fx, 0.3 * 0.5 * view.height / fy
    tx = z * torch.clamp(x / z, -(cx / fx + pad_x), (view.width - cx) / fx + pad_x)
    ty = z * torch.clamp(y / z, -(cy / fy + pad_y), (view.height - cy) / fy + pad_y)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * tx / z**2, zero, fy / z, -fy * ty / z**2]).view(2, 3)
    axes = rotation(g.quats[i]) @ torch.diag(g.scales[i].exp())
    R = view.viewmat[:3, :3]
    sharp = J @ R @ axes @ axes.T @ R.T @ J.T
    cov = sharp + 0.3 * torch.eye(2, dtype=z.dtype)
    det = torch.linalg.det(cov)
    opacity = torch.sigmoid(g.opacities[i, 0])
    if antialiased:
        opacity = opacity * torch.sqrt(torch.linalg.det(sharp).clamp_min(0) / det)
    mid = cov.trace().item() / 2
    radius = math.ceil(3 * math.sqrt(mid + math.sqrt(max(0.01, mid * mid - det.item()))))
    conic = torch.linalg.inv(cov)
    return mean, lambda pixel: 0.5 * (mean - pixel) @ conic @ (mean - pixel), opacity, radius


def _project_surfel(g: Gaussians, i: int, mean_c: Tensor, view: View) -> tuple:
    """The same of the i-th surfel, whose plane each ray is intersected with."""
    axes = view.viewmat[:3, :3] @ rotation(g.quats[i])[:, :2] * g.scales[i, :2].exp()
    columns = torch.cat((axes, mean_c[:, None]), dim=1)
    conic = view.K @ columns @ torch.diag(mean_c.new_tensor([1.0, 1.0, -1.0])) @ columns.T @ view.K.T
    conic = conic / conic[2, 2]  # dual, of the outline of one standard deviation
    middle = conic[:2, 2]
    extent = (middle * middle - conic.diagonal()[:2]).max().item()

    def sigma(pixel: Tensor) -> Tensor:
        ray = torch.linalg.inv(view.K) @ torch.cat((pixel, pixel.new_ones(1)))
        s, t, _ = torch.linalg.solve(torch.cat((axes, -ray[:, None]), dim=1), -mean_c)
        return torch.minimum(0.5 * (s * s + t * t), (middle - pixel).square().sum())

    opacity = torch.sigmoid(g.opacities[i, 0])
    return middle, sigma, opacity, math.ceil(3 * math.sqrt(max(1e-4, extent)))


def _splats(
    g: Gaussians, view: View, sh_degree: int, antialiased: bool, windowed: bool, surfels: bool
) -> tuple[Tensor, list[_Splat]]:
    R, t = view.viewmat[:3, :3], view.viewmat[:3, 3]
    center = -R.T @ t
    means_c = [R @ g.means[i] + t for i in range(len(g))]
    means2d = torch.stack([(view.K @ mean)[:2] / mean[2] for mean in means_c])
    splats = []
    for i in range(len(g)):
        found = _project(g, i, means2d[i], means_c[i], view, antialiased)
        if surfels:
            found = _project_surfel(g, i, means_c[i], view)
        middle, sigma, opacity, radius = found
        (x, y), (width, height) = middle.tolist(), (view.width, view.height)
        if not (-radius < x < width + radius and -radius < y < height + radius):
            radius = 0
        color = sh_color(g.features_dc[i], g.features_rest[i], g.means[i] - center, sh_degree)
        splats.append(_Splat(middle, sigma, opacity, color, means_c[i][2], radius, windowed))
    return means2d, splats


def _touches_tile(splat: _Splat, px: int, py: int) -> bool:
    """Whether the square of the radius touches the 16 px tile that holds the pixel."""
    return all(
        math.floor((center - splat.radius) / 16) <= pixel // 16 < math.ceil((center + splat.radius) / 16)
        for center, pixel in zip(splat.mean.tolist(), (px, py), strict=True)
    )


def _pixel(splats: list[_Splat], px: int, py: int, near: float, far: float) -> tuple[Tensor, Tensor, Tensor]:
    zero = torch.zeros((), dtype=torch.float64)
    color, depth, T = torch.zeros(3, dtype=torch.float64), zero, zero + 1
    for splat in splats:
        if not _touches_tile(splat, px, py) or (splat.windowed and not near <= splat.depth.item() < far):
            continue
        sigma = splat.sigma(torch.tensor([px + 0.5, py + 0.5], dtype=torch.float64))
        alpha = torch.clamp_max(splat.opacity * torch.exp(-sigma), 0.999)
        if sigma.item() < 0 or alpha.item() < 1 / 255:
            continue
        if (T * (1 - alpha)).item() <= 1e-4:
            break
        color = color + alpha * T * splat.color
        depth = depth + alpha * T * splat.depth
        T = T * (1 - alpha)
    return color, T, depth


def naive_rasterize(
    gaussians: Gaussians,
    view: View,
    *,
    sh_degree: int,
    crop: Crop | None = None,
    frozen: Gaussians | None = None,
    near: Tensor | None = None,
    far: Tensor | None = None,
    antialiased: bool = False,
    primitive: str = "3dgs",
) -> NaiveRaster:
    """Draw what is before the camera in float64. `near` and `far` [h, w] are the z window, of the frozen if
    any, else of all."""
    crop = crop or view.full
    options = (sh_degree, antialiased)
    own_window, surfels = near is not None and frozen is None, primitive == "2dgs"
    means2d, own = _splats(gaussians, view, *options, own_window, surfels)
    everyone = list(own)
    if frozen is not None:
        everyone += _splats(frozen.detach(), view, *options, near is not None, surfels)[1]
    drawable = [s for s in everyone if s.radius > 0]
    drawable.sort(key=lambda s: s.depth.item())  # stable: ties by index
    pixels = []
    for row in range(crop.height):
        for col in range(crop.width):
            low, high = (
                (-math.inf, math.inf) if near is None else (float(near[row, col]), float(far[row, col]))
            )
            pixels.append(_pixel(drawable, crop.x + col, crop.y + row, low, high))
    color, T, depth = (torch.stack([p[k] for p in pixels]) for k in range(3))
    size, radii = (crop.height, crop.width), [s.radius for s in own]
    return NaiveRaster(color.view(*size, 3), T.view(size), depth.view(size), means2d, radii)
