"""What a block is to make good of the pictures while others are trained at the same time: its share.

Blocks that begin from old versions of each other all see the same error. If each makes good all of it, they
overshoot together (docs/design.md, Freshness). So each is trained towards a picture between the one that its
visit begins with and the photo:

    target = picture + share (photo - picture)        share = w / (w + q o)

w and o are the blend weights of the block and of all others in a pixel, sums of alpha T. q is the part of the
others that is in flight at the same time. The shares of blocks in flight together add up to 1.
"""

from collections.abc import Callable, Collection, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import LayersDrawn
from abcd_ns.engine.layers.layer_store import Kept, LayerStore, rounded
from abcd_ns.engine.render import Raster
from abcd_ns.engine.space.influence import Influence, weights_by_pixel
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.batch import Sample
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.train.visit_training import VisitTraining
from abcd_ns.engine.types import Gaussians

FAINT = 0.01  # weight that a block is given in every pixel, so that shares exist where no block shows
ROOM = 10 / 26  # of that for layers, for pictures: 5 numbers a pixel, where F and B have 8


def shares(own: Float[Tensor, "h w"], whole: Float[Tensor, "h w"], beside: float) -> Float[Tensor, "h w"]:
    """A block's share of each pixel's error, by w, w + o and q; see above."""
    own = own + FAINT
    return own / (own + beside * (whole + FAINT - own).clamp_min(0))


def shown_beside(
    influence: Influence, block: int, others: Collection[int], blocks: int, views: Sequence[int]
) -> dict[int, float]:
    """By view, which part of the other blocks' weight is in flight at the same time, in `others`; views that
    show none of these are left out. Where influences are not known, all of the `blocks` weigh the same."""
    found = {}
    for view in views:
        shown = {b: known.get(view, 0.0) for b, known in influence.items() if b != block}
        part, whole = sum(shown.get(b, 0.0) for b in sorted(others)), sum(shown.values())
        part = part / whole if whole > 0 else len(others) / max(blocks - 1, 1)
        if part > 0:
            found[view] = min(part, 1.0)
    return found


class SharedResidual:
    """The pictures that a visit begins with, and what its block is to add to them. `own` gives the block as
    others draw it: without what joins it in this visit. Pictures without `room` are drawn when needed."""

    def __init__(
        self,
        run: TrainingRun,
        training: VisitTraining,
        own: Callable[[], Gaussians],
        beside: Mapping[int, float],
        room: LayerRoom,
    ) -> None:
        self._run, self._training, self._own, self._beside = run, training, own, beside
        self._degree, self._store = training.degree, LayerStore(run.device, room.device, room.ram)
        if beside:
            gaussians = own().to(run.device)
            for done, view in enumerate(beside, start=1):
                self._store.put(view, Kept(self._draw(gaussians, view)))
                run.announce(LayersDrawn(run.active.number, done, len(beside)))

    def target(self, sample: Sample, photo: Float[Tensor, "_h _w 3"]) -> Float[Tensor, "_h _w 3"]:
        """What a sample is trained on in its photo's place."""
        view = sample.view.index
        if view not in self._beside:
            return photo
        kept = self._store.get(view)
        found = self._draw(self._own().to(self._run.device), view) if kept is None else kept.layers
        part = sample.crop.within(self._run.active.geometry.crops[view])
        (found,) = found[(slice(None), *part.slices)].to(sample.background.dtype)
        light = self._run.light
        raster = Raster(found[..., :3], found[..., 3], found[..., 3], {})
        began = sample.picture(raster, None if light is None else light.of(view))
        return began.lerp(photo.to(began), found[..., 4:])

    @torch.no_grad()
    def _draw(self, own: Gaussians, view: int) -> Float[Tensor, "1 h w 5"]:
        """What the rasterizer drew of a view, and the block's shares of it."""
        run, sample = self._run, self._training.whole(view)
        options = {"antialiased": run.config.antialiased}
        (raster,) = run.rasterizer.draw(own, [sample.shot], sh_degree=self._degree, **options)
        weights = weights_by_pixel(own, run.rasterizer, sample.shot, **options)
        left = raster.transmittance
        if sample.layers is not None:
            front, back = sample.layers.front.transmittance, sample.layers.back.transmittance
            weights, left = front * weights, front * left * back
        parts = (raster.transmittance, shares(weights, 1 - left, self._beside[view]))
        return rounded(torch.cat((raster.color, torch.stack(parts, dim=-1)), dim=-1)[None])
