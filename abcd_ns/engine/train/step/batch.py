"""What one step of training is given, and what it draws."""

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.layers.compositing import composite, sandwich
from abcd_ns.engine.layers.layer_renderer import FrozenLayers
from abcd_ns.engine.render import Raster, Shot, ZWindow
from abcd_ns.engine.render.base import ResidualSums, Surroundings
from abcd_ns.engine.render.loss import photometric_loss, ssim_windows
from abcd_ns.engine.render.pictures import lacking
from abcd_ns.engine.train.capture.light import lit
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.growing import Judged
from abcd_ns.engine.transfer import upload
from abcd_ns.engine.types import Crop, Layer, View

Target = tuple[Float[Tensor, "h w 3"], Tensor | None]
"""What a sample's picture should be, 0..1, and where that counts: [h, w, 1], None for everywhere."""
Pictures = Sequence[Float[Tensor, "_h _w 3"]]
"""One for each sample of a step, 0..1."""
BACKGROUNDS = 1024
"""Steps whose backgrounds a device gets in one copy."""
COMING = 8
"""Views of the next steps whose photos are announced ahead."""
ALIGN = 16
"""Parts meet at multiples of this in the image, pixels: gsplat's tiles are whole then."""
PLAY = 64
"""Pixels by which the lines between parts move from step to step, where parts are larger. SSIM's windows of
11 px are left out where a line crosses them: by columns, and by rows, one time in five at most."""


@dataclass(frozen=True)
class Sample:
    """One view that a step trains on."""

    view: View
    crop: Crop
    layers: FrozenLayers | None
    """What is frozen around the block, if anything is."""
    window: ZWindow | None
    """Where fragments of what is frozen inside count; None for everywhere."""
    background: Float[Tensor, "3"]
    share: float = 1.0
    """Of the pixels that might have been drawn in this step, those that are: the crop's."""

    @property
    def in_front(self) -> Float[Tensor, "h w"] | None:
        """Transmittance of what lies before the block; None for nothing."""
        return None if self.layers is None else self.layers.front.transmittance

    @property
    def shot(self) -> Shot:
        inside = None if self.layers is None else self.layers.inside
        return Shot(self.view, self.crop, inside, None if inside is None else self.window)

    @property
    def source(self) -> Crop:
        """The pixels of the photo that the crop shows."""
        return self.crop.enlarged(self.view.reduction)

    def reduced(self, photo: Float[Tensor, "_h _w c"]) -> Float[Tensor, "h w c"]:
        """The photo's `source`, as large as the crop: means of squares; with alpha, of what it shows."""
        by = self.view.reduction
        if by == 1:
            return photo
        if photo.shape[-1] == 4:
            shown = _mean_of_squares(torch.cat((photo[..., :3] * photo[..., 3:], photo[..., 3:]), dim=-1), by)
            return torch.cat((shown[..., :3] / shown[..., 3:].clamp_min(1e-6), shown[..., 3:]), dim=-1)
        return _mean_of_squares(photo, by)

    def reduced_mask(self, mask: Bool[Tensor, "_h _w 1"] | None) -> Bool[Tensor, "h w 1"] | None:
        """The mask of `source`, as large as the crop: a pixel counts where all of its square does."""
        by = self.view.reduction
        return mask if by == 1 or mask is None else _mean_of_squares((~mask).float(), by) == 0

    def picture(self, raster: Raster, light: Tensor | None = None) -> Float[Tensor, "h w 3"]:
        """What the rasterizer drew, between the layers and on the background, 0..1; see `lit` for `light`."""
        if self.layers is None:
            rgb = composite(raster.layer, self.background)
        else:
            rgb = sandwich(self.layers.front, raster.layer, self.layers.back, self.background)
        return (rgb if light is None else lit(rgb, light)).clamp(0, 1)

    def surroundings(self, blend_weights: bool) -> Surroundings:
        """What the drawing is shown in, see `picture`; for `blend_weights` see `with_blend_weights`."""
        front, back = (None, None) if self.layers is None else (self.layers.front, self.layers.back)
        return Surroundings(front, back, self.background, blend_weights / self.share)

    def loss(
        self, picture: Float[Tensor, "h w 3"], photo: Float[Tensor, "h w 3"], config: TrainingConfig
    ) -> Float[Tensor, ""]:
        """Photometric, as this crop's part of the loss of the whole image; for `share` see `random_part`."""
        found = photometric_loss(
            picture,
            photo,
            full_pixels=self.view.full.pixels,
            full_windows=ssim_windows(self.view.height, self.view.width),
            ssim_lambda=config.ssim_lambda,
            pixel_loss=config.recipe.pixel_loss,
        )
        return found if self.share == 1 else found / self.share


def _mean_of_squares(pixels: Float[Tensor, "_h _w c"], by: int) -> Float[Tensor, "h w c"]:
    return F.avg_pool2d(pixels.permute(2, 0, 1), by).permute(1, 2, 0)


@dataclass(frozen=True)
class Batch:
    """What one step trains on."""

    samples: tuple[Sample, ...]
    at_once: int = 0
    """Samples that are drawn at once, at most; 0 is no limit."""
    share: float = 1.0
    """What a part of a step's batch counts for in the step."""

    def parts(self) -> Iterator["Batch"]:
        """What is drawn one after the other, backward included, so that less memory is needed."""
        every = self.at_once or len(self.samples)
        for first in range(0, len(self.samples), every):
            few = self.samples[first : first + every]
            yield replace(self, samples=few, share=len(few) / len(self.samples))

    def loss(self, pictures: Pictures, photos: Pictures, config: TrainingConfig) -> Float[Tensor, ""]:
        """What it adds to the loss of its step: the mean of the samples', times `share`."""
        triples = zip(self.samples, pictures, photos, strict=True)
        first, *others = [sample.loss(picture, photo, config) for sample, picture, photo in triples]
        mean = sum(others, start=first) / len(self.samples) if others else first
        return mean if self.share == 1 else mean * self.share


@dataclass(frozen=True)
class Rendered:
    """The active block within its surroundings, as a batch shows it."""

    pictures: tuple[Float[Tensor, "_h _w 3"], ...]
    """Of each sample's crop, background included, 0..1."""
    rasters: tuple[Raster | Layer, ...]
    """Of the active block and what was sorted in with it."""
    infos: tuple[dict[str, Any], ...]
    lights: Sequence[Tensor | None] = ()
    """Each picture's transform, see Light."""
    views: Sequence[View] = ()

    @property
    def kept(self) -> "Rendered":
        """What `Trainer` reads of it after backward: neither pictures nor what backward goes through."""
        kept = "weights", "sums"
        infos = tuple({name: info[name] for name in kept if name in info} for info in self.infos)
        return replace(self, pictures=(), rasters=(), infos=infos)

    @staticmethod
    def joined(parts: Sequence["Rendered"]) -> "Rendered":
        names = [field.name for field in fields(Rendered)]
        return Rendered(*(tuple(chain(*(getattr(part, name) for part in parts))) for name in names))


class Residuals:
    """What a step's pictures lack, summed up for each Gaussian by the backward pass: growth judges by it."""

    def __init__(self) -> None:
        self._asked: list[tuple[ResidualSums, int, View, Tensor, float]] = []

    @torch.no_grad()
    def ask(
        self, rendered: Rendered, samples: Sequence[Sample], pictures: Pictures, photos: Pictures
    ) -> None:
        """Call before the backward pass, with what was rendered of these samples and the loss compares."""
        for info in (info for info in rendered.infos if "sums" in info):
            own = [place for place, raster in enumerate(rendered.rasters) if raster.info is info]
            found = [lacking(pictures[place], photos[place], samples[place].in_front) for place in own]
            info["sums"].ask([residual for residual, _ in found])
            for k, (place, (_, error)) in enumerate(zip(own, found, strict=True)):
                self._asked.append((info["sums"], k, samples[place].view, error, samples[place].share))

    def found(self) -> list[Judged]:
        """Call after it. Gives each picture once, and none of a block without Gaussians."""
        asked, self._asked = self._asked, []
        known = ((sums.values, *rest) for sums, *rest in asked)
        return [Judged(view, sums[k], *rest) for sums, k, view, *rest in known if sums is not None]


def background(config: TrainingConfig, step: int, place: int) -> Float[Tensor, "3"]:
    """What lies behind the scene in the sample at `place` of a step's batch; depends on nothing else."""
    if config.background == "random":
        drawn = random.Random(f"background {config.seed} {step} {place}").getrandbits(62)
        return torch.rand(3, generator=torch.Generator().manual_seed(drawn))
    return torch.full((3,), float(config.background == "white"))


class Backgrounds:
    """`background` on the device."""

    def __init__(self, config: TrainingConfig, device: torch.device) -> None:
        self._config, self._device = config, device
        self._tables: dict[int, tuple[int, Float[Tensor, "s 3"]]] = {}

    def at(self, step: int, place: int) -> Float[Tensor, "3"]:
        if self._device.type == "cpu":
            return background(self._config, step, place)
        first = step - step % BACKGROUNDS
        known, table = self._tables.get(place, (None, None))
        if known != first:
            drawn = (background(self._config, first + k, place) for k in range(BACKGROUNDS))
            table = upload(torch.stack(list(drawn)), self._device)
            self._tables[place] = first, table
        return table[step - first]


def part_to_draw(config: TrainingConfig, crop: Crop, step: int, place: int) -> Crop:
    """What the sample at `place` of a step's batch is drawn of a crop; depends on nothing else."""
    return random_part(crop, config.limits.crop_pixels, random.Random(f"part {config.seed} {step} {place}"))


def random_part(crop: Crop, most: int, rng: random.Random) -> Crop:
    """One of the rectangles that a random grid cuts the crop into, as likely as it is large.

    The grid has as few columns and rows of equal cells as keep these within `most` pixels and nearly square.
    A loss that is a sum over pixels keeps its expectation whatever the grid, if that of a part is multiplied
    by crop.pixels / part.pixels: a part is drawn with probability part.pixels / crop.pixels.

    Args:
        most: pixels of the part; 0 for no limit. A part may have ALIGN x ALIGN in any case.
        rng: left alone where the crop is small enough.
    """
    if most <= 0 or crop.pixels <= most:
        return crop
    columns, rows = _counts(crop, most)
    x, width = _random_span(crop.x, crop.width, columns, rng)
    y, height = _random_span(crop.y, crop.height, rows, rng)
    return Crop(x, y, width, height)


def _counts(crop: Crop, most: int) -> tuple[int, int]:
    """Columns and rows of the grid."""
    columns = rows = 1
    while True:
        width, height = _side(crop.x, crop.width, columns), _side(crop.y, crop.height, rows)
        if width * height <= most or max(width, height) <= ALIGN:
            return columns, rows
        if width >= height:
            columns += 1
        else:
            rows += 1


def _side(start: int, size: int, count: int) -> int:
    """Pixels of each of `count` cells along one axis; the grid sticks out of the crop by PLAY or more."""
    if count == 1:
        return size
    covered = size + start % ALIGN
    play = min(PLAY, covered // count // ALIGN * ALIGN)
    return ALIGN * max(1, -(-(covered + play) // (count * ALIGN)))


def _random_span(start: int, size: int, count: int, rng: random.Random) -> tuple[int, int]:
    """First pixel and number of pixels of the cell that a random pixel lies in."""
    if count == 1:
        return start, size
    side, origin = _side(start, size, count), start - start % ALIGN
    slack = count * side - (start + size - origin)
    origin -= ALIGN * rng.randrange(slack // ALIGN + 1)
    first = origin + (start + rng.randrange(size) - origin) // side * side
    low, high = max(first, start), min(first + side, start + size)
    return low, high - low
