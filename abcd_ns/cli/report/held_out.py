"""Held-out views of a run: scores of all of them, and pictures of a few."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

import matplotlib
import numpy as np
from PIL import Image

from abcd_ns.engine.train.schedule import evenly
from abcd_ns.lab.compare.pictures import ERROR_COLORS, ERROR_GAIN, PictureArray, error_map
from abcd_ns.lab.results.results import ViewScore
from abcd_ns.lab.runs.evaluate import Drawn, draw_held_out, mean, ordering_gap, to_bytes
from abcd_ns.nerfstudio.pipeline import AbcdPipeline
from abcd_ns.progress_bar import tracked
from abcd_ns.viewer.images import data_uri

PAGE_PIXELS = 6_000_000
"""Of all pictures of a page together; larger ones are reduced. As JPEG that is some 3 MiB."""
FOG_VIEWS = 16  # training views, at most, that fog is looked for in
LOSSLESS_PIXELS = 40_000  # pictures no larger than this are PNG: JPEG would spoil what little there is


@dataclass(frozen=True)
class Shown:
    """A view with its pictures, as data URIs."""

    score: ViewScore
    place: str  # its rank among all views by PSNR, in words
    photo: str
    picture: str
    error: str
    width: int  # of the pictures in the page, px
    height: int


@dataclass(frozen=True)
class HeldOut:
    """Scores and pictures of the held-out views."""

    scores: tuple[ViewScore, ...]
    gap: str  # the ordering gap, or why there is none
    shown: tuple[Shown, ...]  # from best to worst
    fog: tuple[float, ...] = ()
    """Shares of the screen that fog takes in a few training views; see `engine/layers/surface.py`."""

    def mean(self, name: str) -> float | None:
        """Over all views, of a field of their scores."""
        return mean([getattr(view, name) for view in self.scores])


def look_at_held_out(pipeline: AbcdPipeline, pictures: int) -> HeldOut:
    """Draw and score every held-out view; keep pictures of `pictures` of them: best, worst and between."""
    scores, gaps, count = [], [], len(pipeline.datamanager.eval_dataset)
    for drawn in tracked(draw_held_out(pipeline), "Held-out views", count):
        scores.append(drawn.score)
        gaps.append(drawn.squared_gap)
    gap, note = ordering_gap(gaps, pipeline.model.tree.num_blocks) if scores else (None, "no held-out view")
    places = pick(scores, pictures)
    shown = {
        drawn.row: _show(drawn, scores[drawn.row], places[drawn.row], len(places))
        for drawn in tracked(draw_held_out(pipeline, places), "Pictures", len(places))
    }
    views = evenly([view for view in pipeline.training_views() if view.nearest], FOG_VIEWS)
    fog = tuple(pipeline.model.fog(view) for view in tracked(views, "Fog"))
    said = note if gap is None else f"{gap:.1f} dB"
    return HeldOut(tuple(scores), said, tuple(shown[row] for row in places), fog)


def pick(scores: Sequence[ViewScore], wanted: int) -> dict[int, str]:
    """Rows of `wanted` views, spread evenly from the best PSNR to the worst, each with its rank in words.
    Unless there are two, the one in the middle is the median, by which the page opens."""
    ranked, last = sorted(scores, key=lambda view: -view.psnr_merged), len(scores) - 1
    wanted = min(wanted, len(ranked))
    ranks = np.linspace(0, last, wanted).round().astype(int).tolist()
    if wanted not in (0, 2):
        ranks[(wanted - 1) // 2] = last // 2
    words = {last // 2: "median", last: "worst", 0: "best"} if last else {0: "the only one"}
    return {ranked[rank].row: words.get(rank, f"{rank + 1} of {last + 1}") for rank in ranks}


def _show(drawn: Drawn, score: ViewScore, place: str, count: int) -> Shown:
    photo, picture = (to_bytes(image) for image in (drawn.photo, drawn.merged))
    amplified = np.clip(error_map(picture, photo) * ERROR_GAIN, 0, 1)
    error = matplotlib.colormaps[ERROR_COLORS](amplified, bytes=True)[..., :3]
    height, width = photo.shape[:2]
    scale = min(1.0, (PAGE_PIXELS / (3 * count * height * width)) ** 0.5)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    return Shown(score, place, *(_resized(image, size) for image in (photo, picture, error)), *size)


def _resized(picture: PictureArray, size: tuple[int, int]) -> str:
    """A picture, uint8 [h, w, 3], in another size, as a PNG or JPEG that stands in the page itself."""
    stream, kind = BytesIO(), "png" if size[0] * size[1] <= LOSSLESS_PIXELS else "jpeg"
    small = Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS)
    small.save(stream, kind, quality=88, optimize=True)
    return data_uri(stream, kind)
