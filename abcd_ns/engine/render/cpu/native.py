"""The native library's projection and compositing, as differentiable functions of tensors."""

import ctypes
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.kernels.native import address, library
from abcd_ns.engine.render.base import SUMS, ResidualSums
from abcd_ns.engine.render.projection import Primitive
from abcd_ns.engine.render.z_window import TileGrid, ZWindow, window_between
from abcd_ns.engine.types import Crop, Gaussians

SIDE = 4
"""Of its tiles, px: a tile is 16 lanes."""
COEFFICIENTS = (0, 3, 8, 15)
"""Of harmonics above degree 0, that it takes."""


_POINTER, _INT, _LONG = ctypes.c_void_p, ctypes.c_int32, ctypes.c_int64


class _Parameters(ctypes.Structure):
    _fields_ = (
        *((name, _POINTER) for name in ("means", "scales", "quats", "dc", "rest", "opacities")),
        *(("n", _LONG), ("coefficients", _LONG)),
    )


class _Part(ctypes.Structure):
    _fields_ = (("planes", _POINTER), ("row", _LONG), ("count", _LONG), ("picture", _INT), ("masked", _INT))


class _Picture(ctypes.Structure):
    _fields_ = (*((name, _INT) for name in Crop._fields), ("near", _POINTER), ("far", _POINTER))


class _Image(ctypes.Structure):
    _fields_ = tuple((name, _POINTER) for name in ("color", "transmittance", "depth", "residual"))


def _parameters(tensors: Sequence[Tensor]) -> _Parameters:
    return _Parameters(*map(address, tensors), len(tensors[0]), tensors[4].shape[1])


class _Project(torch.autograd.Function):
    """Parameters in the order of _Parameters, and cameras [v, c] without gradients -> planes [v, r, n]."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Float[Tensor, "v r n"]:
        *tensors, cameras, primitive = inputs
        tensors = [tensor.contiguous() for tensor in tensors]
        planes = cameras.new_empty((len(cameras), primitive.rows, len(tensors[0])))
        given = primitive.name == "2dgs", ctypes.byref(_parameters(tensors))
        library().abcd_project(*given, address(cameras), len(cameras), address(planes))
        ctx.save_for_backward(*tensors, cameras)
        ctx.primitive = primitive
        return planes

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Float[Tensor, "v r n"]) -> tuple[Tensor | None, ...]:
        *tensors, cameras = ctx.saved_tensors
        found, grad = [torch.empty_like(tensor) for tensor in tensors], grad.contiguous()
        given = ctx.primitive.name == "2dgs", ctypes.byref(_parameters(tensors))
        into = ctypes.byref(_parameters(found))
        library().abcd_project_back(*given, address(cameras), len(cameras), address(grad), into)
        return *found, None, None


def project(
    gaussians: Gaussians, cameras: Float[Tensor, "v c"], primitive: Primitive
) -> Float[Tensor, "v r n"]:
    """As project_in_torch, but cameras take no gradients."""
    g = gaussians
    tensors = (g.means, g.scales, g.quats, g.features_dc, g.features_rest, g.opacities)
    return _Project.apply(*tensors, cameras, primitive)


@dataclass(frozen=True)
class Part:
    """Splats of one picture."""

    planes: Float[Tensor, "r n"]
    picture: int
    masked: bool = False
    """Whether the picture's window applies to them."""


Windows = Sequence[ZWindow | None]
"""Of each picture; None masks nothing."""
Pictures = list[tuple[Float[Tensor, "_h _w 3"], Float[Tensor, "_h _w"], Float[Tensor, "_h _w"]]]
"""Colour, transmittance and depth."""


class Lists:
    """What each tile of some pictures has to draw, front to back. Windows leave out of masked parts what lies
    outside; with `wants_weights` depths are 0, see Rasterizer.draw."""

    def __init__(
        self,
        parts: Sequence[Part],
        crops: Sequence[Crop],
        primitive: Primitive,
        windows: Windows,
        wants_weights: bool,
    ) -> None:
        self.primitive, self.crops = primitive, tuple(crops)
        self.absolute: Tensor | None = None
        """Gets gsplat's `absgrad` [v, n, 2] with the gradients, where no residuals are asked."""
        self._parts = [part.planes.detach().contiguous() for part in parts]  # read when gradients are taken
        rows = [
            _Part(address(planes), planes.shape[1], planes.shape[1], part.picture, part.masked)
            for planes, part in zip(self._parts, parts, strict=True)
        ]
        pictures = _Windowed(self.crops, windows)
        of_parts, of_pictures = ((_Part * len(rows))(*rows), len(rows)), (pictures.rows, len(crops))
        self.handle = library().abcd_lists(primitive.name == "2dgs", *of_parts, *of_pictures, wants_weights)
        weakref.finalize(self, library().abcd_free, self.handle)

    def draw(self, windows: Windows = (), keep: bool = False) -> Pictures:
        """What lies in the windows; without any, `keep` what gradients take."""
        sizes = [(crop.height, crop.width) for crop in self.crops]
        images = [(torch.empty((*size, 3)), torch.empty(size), torch.empty(size)) for size in sizes]
        pictures = _Windowed(self.crops, windows)
        library().abcd_draw(self.handle, pictures.rows, _as_images(images), keep)
        return images

    def composite(
        self, planes: Float[Tensor, "v r n"], means2d: Float[Tensor, "v n 2"], weights: Tensor | None
    ) -> tuple[Pictures, ResidualSums]:
        """The pictures, differentiable in the planes of the first parts, one for each picture.

        Args:
            means2d: does not change what is drawn, and gets the gradients of the middles.
            weights: [v, n], likewise of the depths.
        """
        sums = ResidualSums()
        drawn = iter(_Composite.apply(planes, means2d, weights, self, sums))
        return list(zip(drawn, drawn, drawn, strict=True)), sums

    def kept_ids(self, windows: Windows) -> Bool[Tensor, "n"]:
        """Which columns, numbered part by part, have a fragment in the windows."""
        columns = sum(planes.shape[1] for planes in self._parts)
        found, pictures = torch.zeros(columns, dtype=torch.bool), _Windowed(self.crops, windows)
        library().abcd_members(self.handle, pictures.rows, address(found))
        return found

    def shown(self, visible: float) -> list[Float[Tensor, "2 _t"]]:
        """By picture what z_window.showing returns."""
        sizes = [TileGrid(crop, SIDE).tiles for crop in self.crops]
        ends = torch.empty((2, sum(sizes)))
        sums = torch.empty((2, sum(sizes)), dtype=torch.float64)
        library().abcd_windows(self.handle, visible, *map(address, (*ends, *sums)))
        parts = (row[None].split(sizes, dim=1) for row in (*ends, *sums))
        return [window_between(*each).flatten(1) for each in zip(*parts, strict=True)]

    def deepen(self, windows: Windows, left: Float[Tensor, "h w"], depth: Float[Tensor, "h w"]) -> None:
        """Transmittance, negative where it is a half or less, and median depth of the one picture, in place:
        from what is in front of these Gaussians to what is with them. See cpp/drawing.h."""
        pictures = _Windowed(self.crops, windows)
        library().abcd_deepen(self.handle, pictures.rows, _as_images([(None, left, depth)]))


class _Windowed:
    """Crops and windows as the library takes them, for one call; holds the tensors meanwhile."""

    def __init__(self, crops: Sequence[Crop], windows: Windows) -> None:
        pairs = zip(crops, windows or [None] * len(crops), strict=True)
        on = [window and window.on(TileGrid(crop, SIDE)) for crop, window in pairs]
        self._ends = [(None, None) if w is None else (w.near.contiguous(), w.far.contiguous()) for w in on]
        rows = [_Picture(*crop, *map(address, ends)) for crop, ends in zip(crops, self._ends, strict=True)]
        self.rows = (_Picture * len(rows))(*rows)


def _as_images(images: Sequence[Sequence[Tensor | None]]) -> ctypes.Array:
    return (_Image * len(images))(*(_Image(*map(address, image)) for image in images))


class _Composite(torch.autograd.Function):
    """See Lists.composite."""

    @staticmethod
    def forward(
        ctx: Any, planes: Tensor, _: Tensor, weights: Tensor | None, lists: Lists, sums: ResidualSums
    ) -> tuple[Tensor, ...]:
        images = lists.draw(keep=any(ctx.needs_input_grad))
        outputs = tuple(tensor for image in images for tensor in image)
        ctx.save_for_backward(*outputs)
        ctx.shape, ctx.lists, ctx.sums, ctx.wants_weights = planes.shape, lists, sums, weights is not None
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        lists, (views, _, n), residuals = ctx.lists, ctx.shape, ctx.sums.asked
        rows, weights = torch.zeros(ctx.shape), torch.zeros((views, n)) if ctx.wants_weights else None
        width = SUMS if residuals else 0 if lists.absolute is None else 2
        extra = torch.zeros((views, n, width)) if width else None
        held = [None if grad is None else grad.contiguous() for grad in grads]
        asked = [held[k : k + 3] for k in range(0, len(held), 3)]
        if residuals:
            asked = [[*given, residual] for given, residual in zip(asked, residuals, strict=True)]
        drawn = [ctx.saved_tensors[k : k + 3] for k in range(0, len(held), 3)]
        given, found = (_as_images(asked), _as_images(drawn)), map(address, (rows, weights, extra))
        library().abcd_draw_back(lists.handle, views * n, *given, *found, width)
        if residuals:
            ctx.sums.values = extra
        elif lists.absolute is not None:
            lists.absolute.absgrad = extra
        center = slice(lists.primitive.center, lists.primitive.center + 2)
        return rows, rows[:, center].transpose(1, 2).contiguous(), weights, None, None
