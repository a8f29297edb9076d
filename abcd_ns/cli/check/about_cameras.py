"""What is doubtful about the cameras: where they are, and what they see."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from abcd_ns.cli.check.survey import Survey
from abcd_ns.cli.findings import Finding, note, warning
from abcd_ns.cli.terminal import few, many

SMALL_BASELINE = 0.02
"""Extent of the cameras, as a share of the median distance to what they see, below which depth is a guess."""
FAR_OFF = 10.0
"""A camera this many times farther from the middle than three quarters of the cameras are is far off."""
FEW_POINTS = 20
"""In a picture."""
FIELDS = 3.0
"""Ratio of angles of view beyond which they are called unlike."""


def one_place(survey: Survey) -> Iterator[Finding]:
    """Cameras that turned but hardly moved."""
    extent = float(np.ptp(survey.centers, axis=0).max())
    depths = survey.seen.depth[np.isfinite(survey.seen.depth)]
    if len(depths) and extent < SMALL_BASELINE * np.median(depths):
        yield warning(
            "one-place",
            f"The cameras lie within {extent:.3g} units, and what they show is {np.median(depths):.3g} units "
            "away. From one place no depth can be told.",
            "Move between photos, sideways too, by a tenth of the distance or more; do not only turn.",
        )


def far_cameras(survey: Survey) -> Iterator[Finding]:
    """Cameras far from all others: as a rule, photos that were registered wrongly."""
    away = np.linalg.norm(survey.centers - np.median(survey.centers, axis=0), axis=1)
    usual = float(np.quantile(away, 0.75, method="lower"))
    rows = np.flatnonzero(away > FAR_OFF * usual) if usual > 0 else []
    if len(rows):
        yield warning(
            "far-cameras",
            f"{many(len(rows), 'camera is', 'cameras are')} far from the others, up to "
            f"{away[rows].max() / usual:.0f} times as far from the middle: "
            f"{few([survey.names[row] for row in rows])}. The scene is scaled until all cameras fit, so the "
            "rest of it becomes tiny.",
            "If they are registered wrongly, remove them from the model (`image_deleter` of the program "
            "colmap).",
        )


def unlike_fields(survey: Survey) -> Iterator[Finding]:
    """Focal lengths that do not belong to one scene."""
    fields = np.array([lens.width / lens.fx for lens in survey.prepared.lenses])
    ratio = fields.max() / fields.min()
    if ratio > FIELDS:
        wide, narrow = survey.names[int(fields.argmax())], survey.names[int(fields.argmin())]
        yield warning(
            "unlike-focal-lengths",
            f"By the model, {wide} is {ratio:.1f} times as wide as {narrow}. If both are of one lens, the "
            "model is wrong.",
            "Make the model again with one camera for all photos (`abcd poses` without --several-lenses; of "
            "the program colmap `--ImageReader.single_camera 1`).",
        )


def distortion(survey: Survey) -> Iterator[Finding]:
    """Which photos will be undistorted, and what becomes of their size."""
    changes = Counter(
        (source.reduced, source.size, source.undistortion.lens.fisheye)
        for source in survey.sources
        if source.undistortion is not None
    )
    if changes:
        listed = [
            f"{many(n, 'photo', 'photos')}{' of a fisheye' if fisheye else ''}, {a} x {b} to {c} x {d}"
            for ((a, b), (c, d), fisheye), n in changes.most_common(3)
        ]
        yield note(
            "distortion",
            f"Lenses with distortion: photos are undistorted in memory and cropped to what all of them show "
            f"({few(listed, len(changes))} px). Nothing is written.",
        )


def blind_views(survey: Survey) -> Iterator[Finding]:
    """Views that show none or few of the points."""
    if not len(survey.points):
        return
    in_view, names = survey.seen.in_view, survey.names
    blind = np.flatnonzero(in_view == 0)
    if len(blind) == len(names):
        yield warning(
            "no-view-sees-points",
            f"None of the {len(survey.points):,} points lies in any picture: points and cameras are not of "
            "one model, or not in the same coordinates.",
            "Take both from one reconstruction. In transforms.json, ply_file_path must be in the coordinates "
            "of the frames.",
        )
        return
    if len(blind):
        yield warning(
            "views-without-points",
            f"{many(len(blind), 'view shows', 'views show')} no point: {few([names[row] for row in blind])}. "
            "Their poses are doubtful, and nothing is there to begin with.",
            "Look at these photos; if they show the scene, make the model again, else remove them.",
        )
    meagre = np.flatnonzero((in_view > 0) & (in_view < FEW_POINTS))
    if len(meagre):
        listed = [f"{names[row]} {in_view[row]:.0f}" for row in meagre]
        yield warning(
            "views-with-few-points",
            f"{many(len(meagre), 'view shows', 'views show')} fewer than {FEW_POINTS} points: {few(listed)}. "
            "Their poses may be inexact.",
            "See whether they are blurred or show little; more photos around them help.",
        )


ALL = (far_cameras, one_place, unlike_fields, blind_views, distortion)
