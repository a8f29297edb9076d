"""gsplat 1.4.0's CUDA functions in torch, under the names and with the signatures of `gsplat.cuda._wrapper`.

    with lent():
        GsplatRasterizer()...  # on CPU tensors, or on the simulated device

Gradients are right. As in CUDA, what is not drawn is left uninitialised: it is NaN here.
Only what this package uses is there: projection by cameras, lists and pictures packed, no backgrounds.
"""

import functools
import inspect
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from gsplat.cuda import _torch_impl, _wrapper
from gsplat.cuda._torch_impl_2dgs import _fully_fused_projection_2dgs
from torch import Tensor

from tests.reference.simulated_device import kernel
from tests.reference.triton_stand_ins import lent_triton

LOG_STOP = math.log(1e-4)
"""Of the transmittance at which drawing stops."""
STAND_INS: dict[str, Callable] = {}
"""By gsplat's names for them."""


class Differentiable(torch.autograd.Function):
    """A kernel, and another for its gradient: torch's own of the same computation, which is done again."""

    @staticmethod
    def forward(ctx: Any, compute: Callable[..., Any], *tensors: Tensor) -> Any:
        ctx.compute = compute
        ctx.save_for_backward(*tensors)
        results = tuple(kernel(compute, *tensors))
        whole = [x for x in results if not x.is_floating_point()]
        ctx.mark_non_differentiable(*whole)
        return results

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor | None) -> Any:
        inputs, wanted = ctx.saved_tensors, ctx.needs_input_grad[1:]
        given = [g for g in upstream if g is not None and g.is_floating_point()]

        def gradient(*tensors: Tensor) -> list[Tensor]:
            leaves = [x.detach().requires_grad_(w) for x, w in zip(tensors, wanted, strict=False)]
            with torch.enable_grad():
                results = [x for x in ctx.compute(*leaves) if x.is_floating_point()]
            asked = [x for x in leaves if x.requires_grad]

            return torch.autograd.grad(results, asked, tensors[len(leaves) :], materialize_grads=True)

        found = iter(kernel(gradient, *inputs, *given))
        return None, *(next(found) if w else None for w in wanted)


def stands_in(**fixed: Any) -> Callable[[Callable], Callable]:
    """Give a function the signature of gsplat's of the same name.

    Args:
        fixed: arguments that the function does not take, and the only value of each that it stands in for.
    """

    def decorate(function: Callable) -> Callable:
        signature = inspect.signature(getattr(_wrapper, function.__name__))

        @functools.wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            bound = signature.bind(*args, **options)
            bound.apply_defaults()
            given = dict(bound.arguments)
            assert {name: given.pop(name) for name in fixed} == fixed
            return function(**given)

        STAND_INS[function.__name__] = call
        return call

    return decorate


def place_surfels(
    means, quats, scales, viewmat, K, *, width: int, height: int, near_plane: float, far_plane: float
) -> list[Tensor]:
    """(radii, means2d, depths, ray_transforms, normals) of one camera: gsplat's own reference, but for radii.

    That has no least radius, as the kernel does, and none where a disc crosses the camera's plane.
    """
    found = _fully_fused_projection_2dgs(means, quats, scales, viewmat[None], K[None], width, height)
    _, means2d, depths, rays, normals = (value[0] for value in found)
    rays = rays.transpose(1, 2)  # the kernel has rows for x, y and w
    with torch.no_grad():
        sign = rays.new_tensor([1.0, 1.0, -1.0])
        f = sign / (rays[:, 2].square() * sign).sum(-1)[:, None]
        extent = means2d.square() - (rays[:, :2].square() * f[:, None]).sum(-1)
        radii = (3 * extent.amax(-1).clamp_min(1e-4).sqrt()).ceil()
        size = means2d.new_tensor([width, height])
        inside = ((means2d + radii[:, None] > 0) & (means2d - radii[:, None] < size)).all(-1)
        drawn = inside & (depths >= near_plane) & (depths <= far_plane)
    return [torch.where(drawn, radii, 0.0).int(), means2d, depths, rays, normals]


def by_camera(
    place: Callable[..., Sequence[Tensor]], splats: Sequence[Tensor], viewmats: Tensor, Ks: Tensor
) -> list[Tensor]:
    """What `place` gives of splats and each camera, radii first: of what is drawn alone. The rest is NaN, and
    has no gradient, not even one of 0 times infinity."""
    found = []
    for camera in zip(viewmats, Ks, strict=True):
        with torch.no_grad():
            radii = place(*splats, *camera)[0]
        drawn = (radii > 0).nonzero()[:, 0]
        values = place(*(x[drawn] for x in splats), *camera)[1:]
        empty = [x.new_full((len(radii), *x.shape[1:]), torch.nan) for x in values]
        found.append([radii, *(e.index_copy(0, drawn, v) for e, v in zip(empty, values, strict=True))])
    return [torch.stack(values) for values in zip(*found, strict=True)]


@stands_in(covars=None, packed=False, sparse_grad=False, radius_clip=0.0, camera_model="pinhole")
def fully_fused_projection(
    means, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, far_plane, calc_compensations
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
    """radii [C, N], means2d [C, N, 2], depths [C, N], conics [C, N, 3], compensations [C, N] or None."""
    options = {"eps2d": eps2d, "near_plane": near_plane, "far_plane": far_plane, "calc_compensations": True}

    def place(means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, K: Tensor) -> list[Tensor]:
        covars, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
        camera = viewmat[None], K[None], width, height
        return [value[0] for value in _torch_impl._fully_fused_projection(means, covars, *camera, **options)]

    def _project(*tensors: Tensor) -> list[Tensor]:
        *found, compensations = by_camera(place, tensors[:3], *tensors[3:])
        if calc_compensations:
            found.append(torch.where(found[0] > 0, compensations, 0.0))  # gsplat initialises these alone
        return found

    found = Differentiable.apply(_project, means, quats, scales, viewmats, Ks)
    return found if calc_compensations else (*found, None)


@stands_in(eps2d=0.3, radius_clip=0.0, packed=False, sparse_grad=False)
def fully_fused_projection_2dgs(
    means, quats, scales, viewmats, Ks, width, height, near_plane, far_plane
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """radii [C, N], means2d [C, N, 2], depths [C, N], ray_transforms [C, N, 3, 3], normals [C, N, 3]. As in
    CUDA, cameras get no gradient."""

    options = {"width": width, "height": height, "near_plane": near_plane, "far_plane": far_plane}
    place = functools.partial(place_surfels, **options)

    def _place(*tensors: Tensor) -> list[Tensor]:
        return by_camera(place, tensors[:3], *tensors[3:])

    return Differentiable.apply(_place, means, quats, scales, viewmats.detach(), Ks.detach())


@stands_in()
def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None) -> Tensor:
    """Colours [..., 3] without the offset of 0.5."""

    def _harmonics(dirs: Tensor, coeffs: Tensor, *masks: Tensor) -> tuple[Tensor]:
        colors = _torch_impl._spherical_harmonics(degrees_to_use, dirs, coeffs)
        return (torch.where(masks[0][..., None], colors, torch.nan) if masks else colors,)

    tensors = (dirs, coeffs) if masks is None else (dirs, coeffs, masks)
    return Differentiable.apply(_harmonics, *(tensor.contiguous() for tensor in tensors))[0]


@stands_in(packed=True)
@torch.no_grad()
def isect_tiles(
    means2d, radii, depths, tile_size, tile_width, tile_height, sort, n_cameras, camera_ids, gaussian_ids
) -> tuple[Tensor, Tensor, Tensor]:
    """tiles per splat [nnz], isect_ids [pairs] (camera | tile << 32 | bits of the depth), flatten_ids."""
    assert n_cameras is not None
    assert camera_ids.shape == gaussian_ids.shape == radii.shape == depths.shape == means2d.shape[:1]
    assert camera_ids.dtype == torch.int64
    assert radii.dtype == torch.int32
    most = torch.tensor([tile_width, tile_height])

    def _isect_tiles(means2d: Tensor, radii: Tensor, depths: Tensor, camera: Tensor) -> tuple[Tensor, ...]:
        drawn, reach = radii > 0, radii[:, None].to(means2d)
        middle = torch.where(drawn[:, None], means2d, 0.0)
        first = ((middle - reach) / tile_size).floor().clamp_min(0).minimum(most).long()
        end = ((middle + reach) / tile_size).ceil().clamp_min(0).minimum(most).long()
        size = (end - first) * drawn[:, None]
        counts = size.prod(dim=-1)
        flatten_ids = torch.repeat_interleave(counts)
        place = torch.arange(len(flatten_ids)) - (counts.cumsum(0) - counts)[flatten_ids]
        (x, y), width = first[flatten_ids].T, size[:, 0][flatten_ids]
        tile = (y + place // width.clamp_min(1)) * tile_width + x + place % width.clamp_min(1)
        bits = depths.float()[flatten_ids].view(torch.int32).long()
        isect_ids = (camera[flatten_ids] << _bits(tile_width, tile_height) | tile) << 32 | bits
        if sort:
            isect_ids, order = isect_ids.sort(stable=True)
            flatten_ids = flatten_ids[order]
        return counts.int(), isect_ids, flatten_ids.int()

    tensors = (tensor.contiguous() for tensor in (means2d, radii, depths, camera_ids))
    return kernel(_isect_tiles, *tensors, waits=1)


def _bits(tile_width: int, tile_height: int) -> int:
    """Of a tile's number."""
    return (tile_width * tile_height).bit_length()


@stands_in()
@torch.no_grad()
def isect_offset_encode(isect_ids: Tensor, n_cameras: int, tile_width: int, tile_height: int) -> Tensor:
    """Where each tile's pairs begin in a sorted list: int32 [C, tile_height, tile_width]."""

    def _offsets(isect_ids: Tensor) -> Tensor:
        tiles = torch.arange(tile_width * tile_height)
        cameras = torch.arange(n_cameras)[:, None] << _bits(tile_width, tile_height)
        found = torch.searchsorted(isect_ids >> 32, cameras | tiles)
        return found.view(n_cameras, tile_height, tile_width).int()

    return kernel(_offsets, isect_ids)


@stands_in(backgrounds=None, packed=True, absgrad=False)
def rasterize_to_pixels(
    means2d,
    conics,
    colors,
    opacities,
    image_width,
    image_height,
    tile_size,
    isect_offsets,
    flatten_ids,
    masks,
) -> tuple[Tensor, Tensor]:
    """Colours [C, h, w, channels] and alphas [C, h, w, 1], from any lists of pairs.

    The last list ends where the pairs do. Of a tile that is masked colours are 0, and alphas are not written.
    """
    assert means2d.shape == (len(opacities), 2)
    assert conics.shape[:2] == (len(opacities), 3)
    assert len(colors) == len(opacities)
    assert flatten_ids.dtype == isect_offsets.dtype == torch.int32
    assert isect_offsets.shape[1] * tile_size >= image_height
    assert isect_offsets.shape[2] * tile_size >= image_width
    assert masks is None or masks.shape == isect_offsets.shape

    def _rasterize(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        *splats, offsets, flatten_ids = tensors[:6]
        shown = tensors[6] if len(tensors) > 6 else torch.ones_like(offsets, dtype=torch.bool)
        lists = _drawn_lists(offsets, flatten_ids, shown, (image_width, image_height, tile_size))
        tiles = _tiles(splats, *lists, tile_size)
        blank = tiles.new_zeros(tiles.shape[2])
        blank[-1] = torch.nan
        tiles = torch.where(shown.flatten()[:, None, None], tiles, blank)
        cameras, rows, cols = offsets.shape
        image = tiles.view(cameras, rows, cols, tile_size, tile_size, -1).transpose(2, 3)
        image = image.flatten(3, 4).flatten(1, 2)[:, :image_height, :image_width].to(splats[2])
        return image[..., :-1].contiguous(), image[..., -1:].contiguous()

    splats = (tensor.contiguous() for tensor in (means2d, conics, colors, opacities))
    tensors = *splats, isect_offsets, flatten_ids, *(() if masks is None else (masks,))
    return Differentiable.apply(_rasterize, *tensors)


@stands_in(backgrounds=None, packed=True, absgrad=False, distloss=False)
def rasterize_to_pixels_2dgs(ray_transforms, normals, densify, **given) -> tuple[Tensor | None, ...]:
    """As `rasterize_to_pixels`; of what else CUDA gives, nothing."""
    count = len(given["opacities"])
    assert (ray_transforms.shape, normals.shape, densify.shape) == ((count, 3, 3), (count, 3), (count, 2))
    return (*rasterize_to_pixels(conics=ray_transforms, packed=True, **given), None, None, None)


def _drawn_lists(
    offsets: Tensor, flatten_ids: Tensor, masks: Tensor, size: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """The same lists, but for tiles that are masked or have no pixel in the image: these draw nothing."""
    width, height, side = size
    rows, cols = (torch.arange(count) * side for count in offsets.shape[1:])
    counts = torch.cat((offsets.flatten(), torch.tensor([len(flatten_ids)]))).diff()
    assert bool((counts >= 0).all())
    drawn = (masks & (rows < height)[:, None] & (cols < width)).flatten()
    first = int(offsets.flatten()[0])
    kept = flatten_ids[first:][torch.repeat_interleave(drawn, counts)]
    counts = counts * drawn
    return (counts.cumsum(0) - counts).view_as(offsets), kept


def _tiles(splats: Sequence[Tensor], offsets: Tensor, flatten_ids: Tensor, side: int) -> Tensor:
    """Composite tiles: [tiles, side * side, channels + 1], alpha last."""
    first, rows = offsets.flatten().long(), flatten_ids.long()
    tile = torch.repeat_interleave(torch.cat((first, first.new_tensor([len(rows)]))).diff())
    number = tile % (offsets.shape[1] * offsets.shape[2])
    origin = torch.stack((number % offsets.shape[2], number // offsets.shape[2]), dim=1) * side
    pixel = torch.arange(side * side)
    centers = torch.stack((pixel % side, pixel // side), dim=1) + 0.5
    # float64: transmittances are differences of logarithms, summed over all tiles.
    means2d, conics, colors, opacities = (values[rows].double() for values in splats)
    offset = (means2d - origin)[:, None] - centers
    if conics.ndim == 3:
        sigma = surfel_sigma(offset, conics, origin[:, None] + centers)
    else:
        (dx, dy), (a, b, c) = offset.unbind(2), conics[:, None].unbind(2)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities[:, None] * torch.exp(-sigma)).clamp_max(0.999)
    alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, 0.0)
    through = torch.log1p(-alpha)
    behind = torch.cat((through.new_zeros(1, side * side), through.cumsum(0)))
    before = behind[:-1] - behind[first][tile]
    weight = torch.where(before + through > LOG_STOP, alpha * before.exp(), 0.0)
    drawn = torch.cat((colors, torch.ones_like(opacities)[:, None]), dim=1)
    image = drawn.new_zeros(len(first), side * side, drawn.shape[1])
    return image.index_add(0, tile, weight[..., None] * drawn[:, None])


def surfel_sigma(offset: Tensor, rays: Tensor, pixels: Tensor) -> Tensor:
    """[pairs, pixels] from the boxes' middles less the pixels, ray transforms, and the pixels."""
    u, v, w = (row[:, None] for row in rays.unbind(1))
    h_u, h_v = pixels[..., :1] * w - u, pixels[..., 1:] * w - v
    s, t, z = torch.linalg.cross(h_u, h_v).unbind(-1)
    on_disc = (s.square() + t.square()) / z.square()
    return 0.5 * torch.minimum(on_disc, 2 * offset.square().sum(-1))


@contextmanager
def lent() -> Iterator[None]:
    """Within, the package's modules call the stand-ins, where they call gsplat's functions by name; and those
    of the package's own kernels."""
    import abcd_ns.engine.render.cuda.backend  # noqa: F401 - so that it is among the modules

    with lent_triton(), pytest.MonkeyPatch.context() as patch:
        for module in [m for n, m in sys.modules.items() if n.startswith("abcd_ns.engine.render")]:
            for name, stand_in in STAND_INS.items():
                if hasattr(module, name):
                    patch.setattr(module, name, stand_in)
        yield
