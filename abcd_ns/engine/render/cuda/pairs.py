"""What gsplat draws in the crops of several cameras at once: one sorted list of (tile, depth) keys.

Each key has the splat that it belongs to. Leaving out those whose depth is not within their tile's window is
all that a z window takes. Lists keep their length for that, since the host would have to wait for a new one:
what is left out goes to the end of the list, to a tile that is not drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
import torch.nn.functional as F
from gsplat.cuda._wrapper import isect_offset_encode, isect_tiles
from jaxtyping import Bool, Float, Int, Int64, Shaped
from torch import Tensor

from abcd_ns.engine.render.base import SUMS, about, moments
from abcd_ns.engine.render.cuda import fused
from abcd_ns.engine.render.cuda.projection import Kind, Projected, corners, numbers
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.render.splat_kernels import GSPLAT_TILE as TILE
from abcd_ns.engine.render.z_window import TileGrid, ZWindow, ends_of, showing
from abcd_ns.engine.types import Crop, Layer

LAST_DEPTH = 0x7FFFFFFF
"""No key's low half is larger: bits of a depth, which is positive."""


@dataclass(frozen=True)
class FlatSplats:
    """m splats of several cameras in one list; pixels of the full images, or of what is drawn of each."""

    cameras: Int64[Tensor, "m"]
    radii: Int[Tensor, "m"]
    means2d: Float[Tensor, "m 2"]
    depths: Float[Tensor, "m"]
    shapes: Float[Tensor, "m s"]
    opacities: Float[Tensor, "m"]
    features: Float[Tensor, "m 4"]

    def __len__(self) -> int:
        return len(self.radii)

    @staticmethod
    def of(
        own: Projected, frozen: Sequence[tuple[int, Splats]] = (), blend_weights: bool = False
    ) -> "FlatSplats":
        """Camera by camera; then what is frozen, as (camera, what it sees) pairs. `blend_weights` is as for
        `project`: zeros for the depths that are composited."""
        count, n = own.radii.shape
        cameras = numbers(count, n, own.radii.device)
        names = ("radii", "means2d", "depths", "shapes", "opacities", "features")
        values = [getattr(own, name).flatten(0, 1) for name in names]
        if not frozen:
            return FlatSplats(cameras, *values)
        firsts = cameras.view(count, n)[:, :1] if n else torch.arange(count, device=cameras.device)[:, None]
        each = Splats(torch.cat([splats.planes for _, splats in frozen], dim=1))
        last = torch.zeros_like(each.depths) if blend_weights else each.depths
        features = torch.cat((each.colors, last[:, None]), dim=-1)
        theirs = (each.radii, each.means2d, each.depths, each.shapes, each.opacities, features)
        frozen_cameras = [firsts[camera].expand(len(splats)) for camera, splats in frozen]
        pairs = zip(values, theirs, strict=True)
        return FlatSplats(torch.cat((cameras, *frozen_cameras)), *(torch.cat(pair) for pair in pairs))


@dataclass(frozen=True)
class TileLayout:
    """A grid of tiles for each of several crops, all as large as the largest; a crop is in the upper left.

    Crops are grown up and left to gsplat's tiles, so that their tiles are those of the full image. Tiles that
    a crop does not have are not drawn.
    """

    crops: tuple[Crop, ...]
    spare: bool
    """Each has a row of tiles below the others, beyond every picture; for what a window leaves out."""

    @cached_property
    def grids(self) -> tuple[TileGrid, ...]:
        return tuple(TileGrid(crop, TILE) for crop in self.crops)

    @cached_property
    def tiled(self) -> tuple[Crop, ...]:
        """The crops as they are drawn."""
        return tuple(
            Crop(x := c.x - c.x % TILE, y := c.y - c.y % TILE, c.x + c.width - x, c.y + c.height - y)
            for c in self.crops
        )

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """(cameras, rows, columns) of tiles."""
        rows = max(grid.rows for grid in self.grids) + self.spare
        return len(self.crops), rows, max(grid.cols for grid in self.grids)

    @property
    def bits(self) -> int:
        """Of a tile's number in a key, as gsplat has them."""
        return (self.shape[1] * self.shape[2]).bit_length()

    @property
    def last_key(self) -> int:
        """The largest: in the last tile of all."""
        cameras, rows, cols = self.shape
        return ((cameras - 1) << self.bits | rows * cols - 1) << 32 | LAST_DEPTH

    def tile(self, isect_ids: Int64[Tensor, "q"]) -> Int64[Tensor, "q"]:
        """Number of each key's tile among those of all cameras."""
        tile = isect_ids >> 32
        if len(self.crops) == 1:
            return tile
        return (tile >> self.bits) * (self.shape[1] * self.shape[2]) + (tile & (1 << self.bits) - 1)

    def drawn(self, device: torch.device) -> Bool[Tensor, "c rows cols"] | None:
        """Which tiles are; None for all."""
        if all((grid.rows, grid.cols) == self.shape[1:] for grid in self.grids):
            return None
        return torch.stack([_mask(grid.rows, grid.cols, *self.shape[1:], device) for grid in self.grids])

    def pixels(self, device: torch.device) -> Int64[Tensor, "c t"]:
        """How many of its crop's each tile holds."""
        return torch.stack([self._padded(grid.pixels(device), grid) for grid in self.grids])

    def spread(self, windows: Sequence[ZWindow | None], like: Tensor) -> Float[Tensor, "2 tiles"]:
        """(near, far) of each camera's window; the same numbers twice, so nothing, where it has no tile."""
        pairs = zip(windows, self.grids, strict=True)
        spread = [self._padded(ends_of(window, grid, like), grid) for window, grid in pairs]
        return torch.stack(spread, dim=1).view(2, -1)

    def _padded(self, values: Shaped[Tensor, "*v t"], grid: TileGrid) -> Shaped[Tensor, "*v tiles"]:
        """Values by tile of a grid, by tile of the sheet; 0 where the grid has none."""
        beyond = (0, self.shape[2] - grid.cols, 0, self.shape[1] - grid.rows)
        return F.pad(values.unflatten(-1, (grid.rows, grid.cols)), beyond).flatten(-2)


@lru_cache(maxsize=1024)
def _mask(rows: int, cols: int, of_rows: int, of_cols: int, device: torch.device) -> Bool[Tensor, "r c"]:
    """True in the upper left corner."""
    with torch.inference_mode(False):  # they outlive this call
        mask = torch.zeros((of_rows, of_cols), dtype=torch.bool, device=device)
        mask[:rows, :cols].fill_(True)
        return mask


@dataclass(frozen=True)
class Drawing:
    """Second half of gsplat's `rasterization(packed=True)`, for crops."""

    kind: Kind
    splats: FlatSplats
    """Relative to the upper left tile of each one's crop."""
    layout: TileLayout
    isect_ids: Int64[Tensor, "q"]
    """Sorted: camera, tile, bits of the depth."""
    flatten_ids: Int[Tensor, "q"]
    """Whose they are."""

    @staticmethod
    def of(kind: Kind, splats: FlatSplats, crops: Sequence[Crop], *, windowed: bool = False) -> "Drawing":
        """What may be drawn in a crop of each camera; `windowed` leaves room for what windows leave out."""
        layout = TileLayout(tuple(crops), windowed)
        # Shifting the principal point instead would change the picture: the projection's clamp depends on it.
        by = corners(layout.tiled, splats.means2d)
        by = by if len(crops) == 1 else by.index_select(0, splats.cameras)
        splats = replace(splats, means2d=splats.means2d - by, shapes=kind.moved(splats.shapes, by))
        if len(splats) == 0:
            return Drawing(kind, splats, layout, splats.cameras, splats.cameras.int())
        _, rows, cols = layout.shape
        ids = {"camera_ids": splats.cameras, "gaussian_ids": splats.cameras}  # the latter are not read
        options = {"packed": True, "n_cameras": len(crops), **ids}
        _, isect_ids, flatten_ids = isect_tiles(
            splats.means2d, splats.radii, splats.depths, TILE, cols, rows, **options
        )
        return Drawing(kind, splats, layout, isect_ids, flatten_ids)

    @property
    def z(self) -> Float[Tensor, "q"]:
        """Camera z of each pair's Gaussian."""
        return self.splats.depths.index_select(0, self.flatten_ids)

    def inside(self, windows: Sequence[ZWindow | None], always: int = 0) -> Bool[Tensor, "q"]:
        """Which pairs lie within their tile's window; those of the first `always` splats do."""
        near, far = self.layout.spread(windows, self.splats.depths)
        tile, z = self.layout.tile(self.isect_ids), self.z
        inside = (z >= near.index_select(0, tile)) & (z < far.index_select(0, tile))
        return inside | (self.flatten_ids < always) if always else inside

    def windowed(self, windows: Sequence[ZWindow | None], always: int = 0) -> "Drawing":
        """Only what `inside` finds: that moves up, in order, and the end of the lists belongs to the last
        tile, a spare one. So the host need not know how many there are."""
        near, far = self.layout.spread(windows, self.splats.depths)
        _, rows, cols = self.layout.shape
        layout = self.layout.bits, rows * cols, self.layout.last_key
        found = fused.windowed(near, far, self.isect_ids, self.flatten_ids, always, *layout)
        if found is not None:
            return replace(self, isect_ids=found[0], flatten_ids=found[1])
        keep = self.inside(windows, always)
        count = len(keep)
        place = torch.where(keep, keep.cumsum(0) - 1, count)  # the others: to one place, which is cut off
        isect_ids = self.isect_ids.new_full((count + 1,), self.layout.last_key)
        isect_ids.scatter_(0, place, self.isect_ids)
        flatten_ids = self.flatten_ids.new_zeros(count + 1).scatter_(0, place, self.flatten_ids)
        return replace(self, isect_ids=isect_ids[:count], flatten_ids=flatten_ids[:count])

    def kept_ids(self, keep: Bool[Tensor, "q"]) -> list[Int64[Tensor, "_k"]]:
        """Of each camera the splats that have any of these pairs; one wait. All have as many splats."""
        held = keep.new_zeros(len(self.splats) + 1)
        held.index_fill_(0, torch.where(keep, self.flatten_ids, len(self.splats)).long(), True)
        of_cameras = held[:-1].view(len(self.layout.crops), -1)
        # In order, those that are held first: so the host learns how many there are in a single copy.
        ids = of_cameras.byte().sort(dim=1, descending=True, stable=True).indices
        counts = of_cameras.sum(1).tolist()
        return [own[:count] for own, count in zip(ids, counts, strict=True)]

    def rasterized(self) -> tuple[Float[Tensor, "c h w 4"], Float[Tensor, "c h w 1"]]:
        """Features and alphas of the whole sheet."""
        return self._rasterize(self._outlines, self.splats.features, self.flatten_ids)

    def layers(self) -> list[Layer]:
        """What each crop looks like."""
        # Its own memory: else each would keep that of all that were drawn with it.
        features, alphas = self.rasterized()
        return [
            Layer(features[k][part][..., :3].contiguous(), 1.0 - alphas[k][part][..., 0])
            for k, part in enumerate(self.parts)
        ]

    def windows(self, visible: float) -> list[ZWindow]:
        """Where the splats show in each crop; see z_window.showing."""
        _, rows, cols = self.layout.shape
        pixels, found = self.layout.pixels(self.isect_ids.device), []
        tile = self.layout.tile(self.isect_ids)
        near, far = showing(pixels, tile, self.z, self.weights(), visible)
        for k, grid in enumerate(self.layout.grids):
            sides = (side[k].view(rows, cols)[: grid.rows, : grid.cols].flatten() for side in (near, far))
            found.append(ZWindow(grid, *sides))
        return found

    def weights(self) -> Float[Tensor, "q"]:
        """For each pair the sum of the Gaussian's weight alpha T over the tile's pixels in its crop: the
        gradient of the picture's sum by one channel of a colour that each pair has for itself."""
        count = len(self.flatten_ids)
        if count == 0:
            return self.z
        outlines = [values.index_select(0, self.flatten_ids) for values in self._outlines]
        dark = outlines[0].new_zeros((count, 1)).requires_grad_()
        each = torch.arange(count, device=dark.device, dtype=self.flatten_ids.dtype)
        with torch.enable_grad():
            picture, _ = self._rasterize(outlines, dark, each)
            shown = [one[part].sum() for one, part in zip(picture, self.parts, strict=True)]
            (found,) = torch.autograd.grad(torch.stack(shown).sum(), dark)
        return found[:, 0]

    def residual_sums(
        self, middles: Float[Tensor, "c n 2"], residuals: Sequence[Float[Tensor, "_h _w 4"]]
    ) -> Float[Tensor, "c n 10"]:
        """See ResidualSums: gradients by features, which stand for them, of the first splats, c n in all.
        Their `middles` are px of the images."""
        outlines = [values.detach() for values in self._outlines]
        asked, found = [moments(*pair) for pair in zip(residuals, self.layout.crops, strict=True)], []
        for channels in (slice(0, 4), slice(4, 7), slice(7, SUMS)):  # a few at a time, for the memory
            shape = len(self.splats), channels.stop - channels.start
            dark = outlines[0].new_zeros(shape).requires_grad_()
            with torch.enable_grad():
                pictures, _ = self._rasterize(outlines, dark, self.flatten_ids)
            upstream = torch.zeros_like(pictures)
            for one, part, wanted in zip(upstream, self.parts, asked, strict=True):
                one[part] = wanted[..., channels]
            found.append(torch.autograd.grad(pictures, dark, upstream)[0][: middles[..., 0].numel()])
        return about(torch.cat(found, dim=1).view(*middles.shape[:2], SUMS), middles)

    @property
    def _outlines(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.splats.means2d, self.splats.shapes, self.splats.opacities

    def _rasterize(
        self, outlines: Sequence[Tensor], features: Float[Tensor, "p f"], flatten_ids: Int[Tensor, "q"]
    ) -> tuple[Tensor, Tensor]:
        """Features and alphas of splats with these means2d [p, 2], shapes [p, s] and opacities [p]."""
        means2d, shapes, opacities = outlines
        cameras, rows, cols = self.layout.shape
        # Whole tiles: of a masked one gsplat's kernel lets the threads go that have a pixel in the picture,
        # and the others would read the whole list.
        size = cols * TILE, (rows - self.layout.spare) * TILE, TILE
        lists = isect_offset_encode(self.isect_ids, cameras, cols, rows), flatten_ids
        # Not only for speed: gsplat's backward pass reads a list to its end, though no pixel asks for it.
        masks = self.layout.drawn(means2d.device)
        given = means2d, shapes, features, opacities, *size, *lists
        return self.kind.draw(*given, masks=masks, packed=True)

    @property
    def parts(self) -> list[tuple[slice, slice]]:
        """Rows and columns of each crop in what is drawn of it."""
        pairs = zip(self.layout.crops, self.layout.tiled, strict=True)
        return [crop.within(tiled).slices for crop, tiled in pairs]
