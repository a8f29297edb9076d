"""gsplat 1.4.0's CUDA functions in torch, under the names and with the signatures of `gsplat.cuda._wrapper`.

    with lent():
        GsplatRasterizer()...  # on CPU tensors, or on the simulated device, where each counts as one launch

Gradients are right. As in CUDA, what is not drawn is left uninitialised: it is NaN here.
Only what this package uses is there: projection by cameras, lists and pictures packed, no backgrounds.
"""

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest
import torch
from gsplat.cuda import _torch_impl
from torch import Tensor

from tests.reference.differentiable_kernel import Differentiable, stands_in
from tests.reference.gsplat_surfel_stand_ins import fully_fused_projection_2dgs, surfel_sigma  # noqa: F401 - lent
from tests.reference.simulated_device import kernel
from tests.reference.triton_stand_ins import lent_triton

PAIRS_AT_ONCE = 4096
"""(Gaussian, tile) pairs that are composited together, unless a tile has more: bounds memory."""
LOG_STOP = math.log(1e-4)
"""Of the transmittance at which drawing stops."""
NAMES = (
    "fully_fused_projection",
    "fully_fused_projection_2dgs",
    "isect_offset_encode",
    "isect_tiles",
    "rasterize_to_pixels",
    "rasterize_to_pixels_2dgs",
    "spherical_harmonics",
)
"""What is stood in for."""


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
    size = image_width, image_height, tile_size
    splats = (tensor.contiguous() for tensor in (means2d, conics, colors, opacities))
    tensors = *splats, isect_offsets, flatten_ids
    return _Rasterize.apply(size, *tensors, *(() if masks is None else (masks,)))


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


class _Rasterize(torch.autograd.Function):
    """Composites tiles, some of them at a time, and does so again for the gradient."""

    @staticmethod
    def forward(ctx: Any, size: tuple[int, int, int], *tensors: Tensor) -> tuple[Tensor, Tensor]:
        ctx.size = size
        ctx.save_for_backward(*tensors)

        def _rasterize(*tensors: Tensor) -> tuple[Tensor, Tensor]:
            *inputs, offsets, flatten_ids, masks = _with_masks(tensors)
            lists = _drawn_lists(offsets, flatten_ids, masks, size)
            parts = torch.cat([_tiles(p, b, (*inputs, *lists), size[2])[0] for p, b in _parts(*lists)])
            parts[~masks.flatten(), :, -1] = torch.nan
            image = _image(parts, offsets, size).to(tensors[2])
            return image[..., :-1].contiguous(), image[..., -1:].contiguous()

        return tuple(kernel(_rasterize, *tensors))

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Any:
        upstream = [gradient.contiguous() for gradient in upstream]
        gradients = kernel(partial(_gradients, ctx.size), *upstream, *ctx.saved_tensors)
        return None, *gradients, *[None] * (len(ctx.saved_tensors) - len(gradients))


def _with_masks(tensors: Sequence[Tensor]) -> Sequence[Tensor]:
    """What is rasterized, with masks: of all tiles where none are given."""
    return tensors if len(tensors) == 7 else (*tensors, torch.ones_like(tensors[4], dtype=torch.bool))


def _parts(offsets: Tensor, flatten_ids: Tensor) -> Iterator[tuple[range, list[int]]]:
    """Tiles that are composited together, and where the pairs of each begin; their end last."""
    starts = [*offsets.flatten().tolist(), len(flatten_ids)]
    first = 0
    for tile in range(len(starts) - 1):
        if tile + 2 == len(starts) or starts[tile + 2] - starts[first] > PAIRS_AT_ONCE:
            yield range(first, tile + 1), starts[first : tile + 2]
            first = tile + 1


def _tiles(
    tiles: range, starts: list[int], tensors: Sequence[Tensor], side: int, wants_gradient: bool = False
) -> tuple[Tensor, list[Tensor], Tensor]:
    """Composite some tiles: [tiles, side * side, channels + 1], alpha last.

    Returns:
        The picture, the values of each pair that it is made of ([pairs, pixels, 2] for the distances from the
        mean), and the row of each pair's Gaussian.
    """
    means2d, conics, colors, opacities, offsets, flatten_ids = tensors
    rows = flatten_ids[starts[0] : starts[-1]].long()
    counts = torch.tensor(starts).diff()
    tile = torch.repeat_interleave(counts)
    first = torch.tensor(starts)[:-1] - starts[0]
    number = torch.arange(tiles.start, tiles.stop)[tile] % (offsets.shape[1] * offsets.shape[2])
    origin = torch.stack((number % offsets.shape[2], number // offsets.shape[2]), dim=1) * side
    pixel = torch.arange(side * side)
    centers = torch.stack((pixel % side, pixel // side), dim=1) + 0.5
    # float64: transmittances are differences of logarithms, summed over all tiles.
    values = [x.detach()[rows].double() for x in (means2d, conics, colors, opacities)]
    values[0] = (values[0] - origin)[:, None] - centers
    values = [x.requires_grad_(wants_gradient) for x in values]
    if values[1].ndim == 3:
        sigma = surfel_sigma(values[0], values[1], origin[:, None] + centers)
    else:
        (dx, dy), (a, b, c) = values[0].unbind(2), values[1][:, None].unbind(2)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (values[3][:, None] * torch.exp(-sigma)).clamp_max(0.999)
    alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, 0.0)
    through = torch.log1p(-alpha)
    behind = torch.cat((through.new_zeros(1, side * side), through.cumsum(0)))
    before = behind[:-1] - behind[first][tile]
    after = before + through
    weight = torch.where(after > LOG_STOP, alpha * before.exp(), 0.0)
    drawn = torch.cat((values[2], torch.ones_like(values[3])[:, None]), dim=1)
    image = drawn.new_zeros(len(tiles), side * side, drawn.shape[1])
    return image.index_add(0, tile, weight[..., None] * drawn[:, None]), values, rows


def _image(tiles: Tensor, offsets: Tensor, size: tuple[int, int, int]) -> Tensor:
    """[C, h, w, channels] from [tiles, side * side, channels]."""
    (width, height, side), (cameras, rows, cols) = size, offsets.shape
    image = tiles.view(cameras, rows, cols, side, side, -1).transpose(2, 3).flatten(3, 4).flatten(1, 2)
    return image[:, :height, :width].contiguous()


def _by_tiles(image: Tensor, offsets: Tensor, side: int) -> Tensor:
    """The inverse of _image; 0 beyond the image."""
    cameras, rows, cols = offsets.shape
    whole = image.new_zeros(cameras, rows * side, cols * side, image.shape[-1])
    whole[:, : image.shape[1], : image.shape[2]] = image
    return (
        whole.view(cameras, rows, side, cols, side, -1)
        .transpose(2, 3)
        .reshape(-1, side * side, image.shape[-1])
    )


def _gradients(size: tuple[int, int, int], *tensors: Tensor) -> list[Tensor]:
    """Of means2d, conics, colours and opacities."""
    by_color, by_alpha, *tensors = tensors
    *inputs, offsets, flatten_ids, masks = _with_masks(tensors)
    lists = _drawn_lists(offsets, flatten_ids, masks, size)
    upstream = _by_tiles(torch.cat((by_color, by_alpha), dim=-1), offsets, size[2]).double()
    sums = [torch.zeros_like(x, dtype=torch.float64) for x in inputs]
    for tiles, starts in _parts(*lists):
        with torch.enable_grad():
            picture, values, rows = _tiles(tiles, starts, (*inputs, *lists), size[2], wants_gradient=True)
            found = torch.autograd.grad(picture, values, upstream[tiles.start : tiles.stop])
        for total, part in zip(sums, (found[0].sum(1), *found[1:]), strict=True):
            total.index_add_(0, rows, part)
    return [total.to(x) for total, x in zip(sums, inputs, strict=True)]


@contextmanager
def lent() -> Iterator[None]:
    """Within, the package's modules call the stand-ins, where they call gsplat's functions by name; and those
    of the package's own kernels."""
    import abcd_ns.engine.render.cuda.backend  # noqa: F401 - so that it is among the modules

    with lent_triton(), pytest.MonkeyPatch.context() as patch:
        for module in [m for n, m in sys.modules.items() if n.startswith("abcd_ns.engine.render")]:
            for name in NAMES:
                if hasattr(module, name):
                    patch.setattr(module, name, globals()[name])
        yield
