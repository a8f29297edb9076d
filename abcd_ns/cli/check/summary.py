"""A scene in a dozen numbers."""

from collections import Counter
from typing import Any

import numpy as np
from rich.console import Console

from abcd_ns.cli.check.survey import Survey
from abcd_ns.cli.terminal import few, print_facts
from abcd_ns.data.input_errors import one_line
from abcd_ns.data.photos import default_budget
from abcd_ns.data.scene import Lens
from abcd_ns.engine.train.memory import parameter_bytes
from abcd_ns.units import bytes_in_words

MIDDLE = (0.05, 0.95)
"""Quantiles between which the points' extent is taken: single wrong ones would decide it otherwise."""


def summarize(survey: Survey) -> dict[str, Any]:
    """The numbers of a scene; lengths are in the units of the model, but for `near_plane`."""
    prepared, points = survey.prepared, survey.points
    sizes = Counter("{} x {}".format(*source.size) for source in prepared.sources)
    lenses = Counter(_in_words(frame.lens) for frame in prepared.scene.frames)
    spread = np.diff(np.quantile(points, MIDDLE, axis=0), axis=0)[0].tolist() if len(points) else []
    return {
        "model": str(prepared.scene.model),
        "photos": len(survey.names),
        "sizes": dict(sizes.most_common()),
        "lenses": dict(lenses.most_common()),
        "masks": sum(source.mask_path is not None for source in prepared.sources),
        "alpha": sum(look.alpha for look in survey.looks),
        "points": len(points),
        "train": len(survey.train),
        "held_out": len(survey.held_out),
        "near_plane": survey.near,
        "near_plane_model": survey.near / prepared.similarity.scale,
        "camera_extent": np.ptp(survey.centers, axis=0).tolist(),
        "point_extent": spread,
        "photo_bytes": survey.photo_bytes,
        "photo_budget_bytes": default_budget(),
        "gaussian_bytes": len(points) * parameter_bytes(sh_degree=3),
    }


def print_summary(s: dict[str, Any], console: Console) -> None:
    """Two columns."""
    more = [f"{s[what]:,} with {word}" for what, word in (("masks", "a mask"), ("alpha", "alpha")) if s[what]]
    photos, budget = bytes_in_words(s["photo_bytes"]), bytes_in_words(s["photo_budget_bytes"])
    if s["photo_bytes"] > s["photo_budget_bytes"]:
        photos = f"{budget} of {photos}"
    extent = f", nine tenths of them within {_box(s['point_extent'])}" if s["point_extent"] else ""
    facts = {
        "model": one_line(s["model"]),
        "photos": ", ".join([f"{s['photos']:,}", _counted(s["sizes"], " px"), *more]),
        "lenses": _counted(s["lenses"]),
        "views": f"{s['train']:,} to train on, {s['held_out']:,} held out",
        "cameras": f"within {_box(s['camera_extent'])} model units",
        "points": f"{s['points']:,}{extent}",
        "near plane": f"{s['near_plane_model']:.3g} model units, {s['near_plane']:.3g} in training",
        "RAM": f"{photos} of photos, {bytes_in_words(s['gaussian_bytes'])} of Gaussians to begin with",
    }
    print_facts(facts, console)


def _in_words(lens: Lens) -> str:
    kind = "fisheye" if lens.fisheye else "distorted" if lens.distorted else "pinhole"
    angle = 2 * np.degrees(np.arctan(lens.width / (2 * lens.fx)))
    wide = "" if lens.fisheye else f", {angle:.0f} degrees wide"
    return f"{kind}, {lens.width} x {lens.height}, f {lens.fx:.0f} px{wide}"


def _counted(photos: dict[str, int], unit: str = "") -> str:
    """What there is, with how often where it is not all the same."""
    if len(photos) == 1:
        return next(iter(photos)) + unit
    return few([f"{count} of {what}{unit}" for what, count in photos.items()])


def _box(sides: list[float]) -> str:
    return " x ".join(f"{float(f'{side:.3g}'):,.12g}" for side in sides)
