"""Held-out views of a run: scores of all of them, and pictures of a few."""

import base64
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO

import matplotlib
import numpy as np
from PIL import Image
from rich.console import Console
from torch import Tensor

from abcd_ns.lab.compare.pictures import ERROR_COLORS, ERROR_GAIN, PictureArray, error_map
from abcd_ns.lab.results.run import ViewScore
from abcd_ns.lab.runs.evaluate import Drawn, draw_held_out, mean, ordering_gap, score, squared_gap
from abcd_ns.nerfstudio.pipeline import AbcdPipeline
from abcd_ns.progress_bar import ProgressBar

PAGE_PIXELS = 6_000_000
"""Of all pictures of a page together; larger ones are reduced. As JPEG that is some 3 MiB."""
LOSSLESS_PIXELS = 40_000
"""Pictures no larger than this are PNG: JPEG would spoil what little there is."""
JPEG_QUALITY = 88


@dataclass(frozen=True)
class Shown:
    """A view with its pictures, as data URIs."""

    score: ViewScore
    place: str
    """Its rank among all views by PSNR, in words."""
    photo: str
    picture: str
    error: str
    width: int
    """Of the pictures in the page, px."""
    height: int


@dataclass(frozen=True)
class HeldOut:
    """What became of the held-out views."""

    scores: tuple[ViewScore, ...]
    gap: str
    """The ordering gap, or why there is none."""
    shown: tuple[Shown, ...]
    """From best to worst."""

    def mean(self, name: str) -> float | None:
        """Over all views, of a field of their scores."""
        return mean([getattr(view, name) for view in self.scores])


def look_at_held_out(pipeline: AbcdPipeline, pictures: int, console: Console) -> HeldOut:
    """Draw and score every held-out view; keep pictures of `pictures` of them: best, worst and between."""
    scores, gaps = [], []
    for drawn in _with_progress(pipeline, "Held-out views", console):
        scores.append(score(drawn))
        gaps.append(squared_gap(drawn))
    gap, note = ordering_gap(gaps, pipeline.model.tree.num_blocks) if scores else (None, "no held-out view")
    places = pick(scores, pictures)
    shown = {}
    for drawn in _with_progress(pipeline, "Pictures", console, places):
        row = drawn.view.row
        shown[row] = _show(drawn, scores[row], places[row], len(places))
    return HeldOut(
        tuple(scores), note if gap is None else f"{gap:.1f} dB", tuple(shown[row] for row in places)
    )


def pick(scores: Sequence[ViewScore], wanted: int) -> dict[int, str]:
    """Rows of `wanted` views, spread evenly from the best PSNR to the worst, each with its rank in words."""
    ranked = sorted(scores, key=lambda view: -view.psnr_merged)
    wanted, last = min(wanted, len(ranked)), len(ranked) - 1
    ranks = [last // 2] if wanted == 1 else [round(k * last / (wanted - 1)) for k in range(wanted)]
    return {ranked[rank].row: _in_words(rank, len(ranked)) for rank in dict.fromkeys(ranks)}


def data_uri(picture: PictureArray, lossless: bool) -> str:
    """A picture, uint8 [h, w, 3], as a PNG or JPEG that stands in the page itself."""
    stream, kind = BytesIO(), "png" if lossless else "jpeg"
    Image.fromarray(picture).save(stream, kind, quality=JPEG_QUALITY, optimize=True)
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"


def error_picture(picture: PictureArray, photo: PictureArray) -> PictureArray:
    """The error, amplified and coloured as in the comparison's pictures."""
    amplified = np.clip(error_map(picture, photo) * ERROR_GAIN, 0, 1)
    return matplotlib.colormaps[ERROR_COLORS](amplified, bytes=True)[..., :3]


def _in_words(rank: int, count: int) -> str:
    if rank == 0:
        return "best" if count > 1 else "the only one"
    if rank == count - 1:
        return "worst"
    return "median" if rank == (count - 1) // 2 or 2 * rank == count else f"{rank + 1} of {count}"


def _with_progress(
    pipeline: AbcdPipeline, title: str, console: Console, rows: Collection[int] | None = None
) -> Iterator[Drawn]:
    """The held-out views that were asked for, drawn."""
    views = len(pipeline.datamanager.eval_dataset) if rows is None else len(rows)
    with ProgressBar(title, views, console) as bar:
        for drawn in draw_held_out(pipeline, rows):
            yield drawn
            bar.advance()


def _show(drawn: Drawn, scored: ViewScore, place: str, count: int) -> Shown:
    photo, picture = _to_bytes(drawn.view.photo), _to_bytes(drawn.merged)
    height, width = photo.shape[:2]
    scale = min(1.0, (PAGE_PIXELS / (3 * count * height * width)) ** 0.5)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    images = [Image.fromarray(image) for image in (photo, picture, error_picture(picture, photo))]
    reduced = [np.asarray(image.resize(size, Image.Resampling.LANCZOS)) for image in images]
    lossless = size[0] * size[1] <= LOSSLESS_PIXELS
    return Shown(scored, place, *(data_uri(image, lossless) for image in reduced), *size)


def _to_bytes(picture: Tensor) -> PictureArray:
    return (picture.clamp(0, 1) * 255).round().byte().cpu().numpy()
