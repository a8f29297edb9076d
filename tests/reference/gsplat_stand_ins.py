"""gsplat 1.4.0's CUDA functions in torch, under the names and with the signatures of `gsplat.cuda._wrapper`.

    with lent():
        GsplatRasterizer()...  # on CPU tensors, or on the simulated device

Gradients are right. As in CUDA, what is not drawn is left uninitialised: it is NaN here.
Only what this package uses is there: projection by cameras, lists and pictures packed, no backgrounds.
"""

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest
import torch
from gsplat.cuda import _torch_impl
from torch import Tensor

from tests.reference.differentiable_kernel import STAND_INS, Differentiable, stands_in
from tests.reference.gsplat_surfel_stand_ins import surfel_sigma
from tests.reference.simulated_device import kernel
from tests.reference.triton_stand_ins import lent_triton

LOG_STOP = math.log(1e-4)
"""Of the transmittance at which drawing stops."""


@stands_in(covars=None, packed=False, sparse_grad=False, radius_clip=0.0, camera_model="pinhole")
def fully_fused_projection(
    means, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, far_plane, calc_compensations
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
    """radii [C, N], means2d [C, N, 2], depths [C, N], conics [C, N, 3], compensations [C, N] or None."""
    options = {"eps2d": eps2d, "near_plane": near_plane, "far_plane": far_plane}

    def project(rows: slice | Tensor, means: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
        quats, scales, viewmat, K = others
        covars, _ = _torch_impl._quat_scale_to_covar_preci(quats[rows], scales[rows], compute_preci=False)
        return _torch_impl._fully_fused_projection(
            means[rows], covars, viewmat[None], K[None], width, height, **options, calc_compensations=True
        )

    def _project(
        means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor
    ) -> Sequence[Tensor]:
        cameras = []
        for viewmat, K in zip(viewmats, Ks, strict=True):
            inputs = means, quats, scales, viewmat, K
            with torch.no_grad():
                radii = project(slice(None), *inputs)[0][0]
            drawn = (radii > 0).nonzero()[:, 0]
            # Those alone: what is not drawn has no gradient, not even one of 0 times infinity.
            values = (value[0] for value in project(drawn, *inputs)[1:])
            empty = [means.new_full((len(means), *size), torch.nan) for size in ((2,), (), (3,))]
            if calc_compensations:
                empty.append(means.new_zeros(len(means)))  # gsplat initialises these alone
            cameras.append([radii, *(e.index_copy(0, drawn, v) for e, v in zip(empty, values, strict=False))])
        return [torch.stack(values) for values in zip(*cameras, strict=True)]

    found = Differentiable.apply(_project, means, quats, scales, viewmats, Ks)
    return found if calc_compensations else (*found, None)


@stands_in()
def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None) -> Tensor:
    """Colours [..., 3] without the offset of 0.5."""

    def _harmonics(dirs: Tensor, coeffs: Tensor, *masks: Tensor) -> tuple[Tensor]:
        colors = _torch_impl._spherical_harmonics(degrees_to_use, dirs, coeffs)
        return (torch.where(masks[0][..., None], colors, torch.nan) if masks else colors,)

    tensors = (dirs, coeffs) if masks is None else (dirs, coeffs, masks)
    tensors = (tensor.contiguous() for tensor in tensors)
    return Differentiable.apply(_harmonics, *tensors)[0]


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


def _in_image(offsets: Tensor, size: tuple[int, int, int]) -> Tensor:
    """Which tiles have a pixel in the image: [rows, cols]."""
    width, height, side = size
    rows, cols = (torch.arange(count) * side for count in offsets.shape[1:])
    return (rows < height)[:, None] & (cols < width)


def _drawn_lists(
    offsets: Tensor, flatten_ids: Tensor, masks: Tensor, size: tuple[int, int, int]
) -> tuple[Tensor, Tensor]:
    """The same lists, but for tiles that are masked or have no pixel in the image: these draw nothing."""
    counts = torch.cat((offsets.flatten(), torch.tensor([len(flatten_ids)]))).diff()
    assert bool((counts >= 0).all())
    drawn = (masks & _in_image(offsets, size)).flatten()
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
