"""A scene in a dozen numbers."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from rich.console import Console

from abcd_ns.cli.check.about_photos import photo_bytes
from abcd_ns.cli.check.survey import Survey
from abcd_ns.cli.terminal import few, print_facts
from abcd_ns.data.input_errors import one_line
from abcd_ns.data.photos import default_budget
from abcd_ns.data.scene import Lens
from abcd_ns.engine.train.memory import parameter_bytes
from abcd_ns.units import bytes_in_words

MIDDLE = (0.05, 0.95)
"""Quantiles between which the points' extent is taken: single wrong ones would decide it otherwise."""


@dataclass(frozen=True)
class Summary:
    """Lengths are in the units of the model, but for `near_plane`."""

    model: str
    """The file or folder that was read."""
    photos: int
    sizes: dict[str, int]
    """Photos by "width x height" as trained on."""
    lenses: dict[str, int]
    """Photos by lens."""
    points: int
    train: int
    held_out: int
    near_plane: float
    """In the units of training, as --pipeline.near-plane has it."""
    near_plane_model: float
    """The same in the units of the model."""
    camera_extent: tuple[float, ...]
    """Sides of the cameras' box."""
    point_extent: tuple[float, ...]
    """Sides of the box of the middle nine tenths of the points; empty without points."""
    photo_bytes: int
    """All photos decoded."""
    photo_budget_bytes: int
    """How much of that stays in RAM by default."""
    gaussian_bytes: int
    """The Gaussians that training begins with, without Adam's moments."""


def summarize(survey: Survey) -> Summary:
    """The numbers of a scene."""
    prepared, points = survey.prepared, survey.points
    sizes = Counter("{} x {}".format(*source.size) for source in survey.sources)
    lenses = Counter(_in_words(frame.lens) for frame in prepared.scene.frames)
    spread = np.diff(np.quantile(points, MIDDLE, axis=0), axis=0)[0] if len(points) else []
    return Summary(
        model=str(prepared.scene.model),
        photos=len(survey.names),
        sizes=dict(sizes.most_common()),
        lenses=dict(lenses.most_common()),
        points=len(points),
        train=len(survey.train),
        held_out=len(survey.held_out),
        near_plane=survey.near,
        near_plane_model=survey.near / prepared.similarity.scale,
        camera_extent=tuple(np.ptp(survey.centers, axis=0).tolist()),
        point_extent=tuple(map(float, spread)),
        photo_bytes=photo_bytes(survey),
        photo_budget_bytes=default_budget(),
        gaussian_bytes=len(points) * parameter_bytes(sh_degree=3),
    )


def print_summary(summary: Summary, console: Console) -> None:
    """Two columns."""
    sizes = _counted({f"{size} px": n for size, n in summary.sizes.items()})
    lenses = _counted(summary.lenses)
    points = f"{summary.points:,}"
    if summary.point_extent:
        points += f", nine tenths of them within {_box(summary.point_extent)}"
    photos = bytes_in_words(summary.photo_bytes)
    if summary.photo_bytes > summary.photo_budget_bytes:
        photos = f"{bytes_in_words(summary.photo_budget_bytes)} of {photos}"
    facts = {
        "model": one_line(summary.model),
        "photos": f"{summary.photos:,}, {few(sizes)}",
        "lenses": few(lenses),
        "views": f"{summary.train:,} to train on, {summary.held_out:,} held out",
        "cameras": f"within {_box(summary.camera_extent)} model units",
        "points": points,
        "near plane": f"{summary.near_plane_model:.3g} model units, {summary.near_plane:.3g} in training",
        "RAM": f"{photos} of photos, {bytes_in_words(summary.gaussian_bytes)} of Gaussians to begin with",
    }
    print_facts(facts, console)


def _in_words(lens: Lens) -> str:
    angle = 2 * np.degrees(np.arctan(lens.width / (2 * lens.fx)))
    if lens.fisheye:
        return f"fisheye, {lens.width} x {lens.height}, f {lens.fx:.0f} px"
    kind = "distorted" if lens.distorted else "pinhole"
    return f"{kind}, {lens.width} x {lens.height}, f {lens.fx:.0f} px, {angle:.0f} degrees wide"


def _counted(photos: dict[str, int]) -> list[str]:
    """What there is, with how often where it is not all the same."""
    return list(photos) if len(photos) == 1 else [f"{count} of {what}" for what, count in photos.items()]


def _box(sides: tuple[float, ...]) -> str:
    return " x ".join(f"{side:,.3g}" for side in sides)
