"""What is wrong or doubtful about a scene that can be read."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from abcd_ns.cli.check.survey import Look, Survey
from abcd_ns.cli.findings import error, note, warning
from abcd_ns.cli.terminal import few
from abcd_ns.data.photos import default_budget
from abcd_ns.data.prepare import DOWNSCALE, MAX_AUTO_SIDE
from abcd_ns.units import bytes_in_words

FEW_PHOTOS, FEW_POINTS, FEW_POINTS_IN_VIEW = 8, 500, 20
MANY_PIXELS = 4e6
"""Of a photo. Scores of 3DGS are usually given for 1.6 million and less."""
DARK, BRIGHT = 0.02, 0.98
"""Mean luma beyond which a photo shows nothing."""
EXPOSURES = 3.0
"""Largest ratio of mean lumas, the brightest and darkest twentieth left out, that one exposure explains. A
room with windows (bonsai, of Mip-NeRF 360) has 2.3."""
SMALL_BASELINE = 0.02
"""Extent of the cameras, as a share of the median depth, below which depth is a guess."""
FAR_CAMERA, FAR_POINT = 10.0, 100.0
"""Distance from the middle, by that of three quarters of the cameras or of nine tenths of the points."""
FIELDS = 3.0
"""Ratio of angles of view beyond which one of them is doubtful."""
UNSEEN = 0.05
"""Share of the points that may lie in no picture."""
Values = dict[str, Any] | None


def named(names: Iterable[str]) -> Values:
    """Their number and the first of them, where there are any."""
    names = list(names)
    return {"count": len(names), "names": few(names)} if names else None


def photos(wanted: Callable[[Look], bool]) -> Callable[[Survey], Values]:
    """The names of photos that show what is wanted."""
    return lambda s: named(name for name, look in zip(s.names, s.looks, strict=True) if wanted(look))


def views(wanted: Callable[[np.ndarray], np.ndarray]) -> Callable[[Survey], Values]:
    """The names of views by the number of points in their pictures, where any view has points."""

    def look(s: Survey) -> Values:
        points = s.seen.in_view
        rows = np.flatnonzero(wanted(points)) if points.any() else []
        return named(f"{s.names[row]} ({points[row]:.0f})" for row in rows)

    return look


def copies(s: Survey) -> Values:
    """Groups of equal photos, and how many of them are both trained on and held out."""
    held_out = set(s.held_out)
    leaks = sum(0 < len(held_out & set(rows)) < len(rows) for rows in s.copies)
    found = named(" = ".join(s.names[row] for row in rows) for rows in s.copies)
    return found and found | {"leaks": f"Both trained on and held out: {leaks}." if leaks else ""}


def exposures(s: Survey) -> Values:
    """How much brightness differs, where that is more than one exposure explains."""
    lumas = np.array([look.brightness for look in s.looks if look.error is None])
    lumas = lumas[(lumas > DARK) & (lumas < BRIGHT)]
    if len(lumas) < FEW_PHOTOS:
        return None
    low, high = np.quantile(lumas, [0.05, 0.95])
    return {"factor": high / low} if high > EXPOSURES * low else None


def large(s: Survey) -> Values:
    """The largest size of a photo."""
    width, height = max((source.size for source in s.sources), key=np.prod)
    return {"width": width, "height": height} if width * height > MANY_PIXELS else None


def beyond_ram(s: Survey) -> Values:
    """How much of the decoded photos is kept in RAM."""
    needed, budget = s.photo_bytes, default_budget()
    return {"needed": bytes_in_words(needed), "kept": bytes_in_words(budget)} if needed > budget else None


def far_cameras(s: Survey) -> Values:
    """Cameras far from all others."""
    away = np.linalg.norm(s.centers - np.median(s.centers, axis=0), axis=1)
    usual = float(np.quantile(away, 0.75, method="lower"))
    found = named(s.names[row] for row in np.flatnonzero(away > FAR_CAMERA * usual)) if usual else None
    return found and found | {"times": away.max() / usual}


def baseline(s: Survey) -> Values:
    """The cameras' extent and the depth of what they see, where the first is too small."""
    extent, depths = float(np.ptp(s.centers, axis=0).max()), s.seen.depth[np.isfinite(s.seen.depth)]
    depth = float(np.median(depths)) if len(depths) else 0.0
    return {"extent": extent, "depth": depth} if extent < SMALL_BASELINE * depth else None


def fields(s: Survey) -> Values:
    """The widest and the narrowest lens, where they differ too much."""
    wide = np.array([lens.width / lens.fx for lens in s.prepared.lenses])
    ends, ratio = [s.names[int(row)] for row in (wide.argmax(), wide.argmin())], wide.max() / wide.min()
    return {"wide": ends[0], "narrow": ends[1], "ratio": ratio} if ratio > FIELDS else None


def far_points(s: Survey) -> Values:
    """Points far from all others."""
    if len(s.points) < 10:
        return None
    away = np.linalg.norm(s.points - np.median(s.points, axis=0), axis=1)
    usual = float(np.quantile(away, 0.9))
    count = int((away > FAR_POINT * usual).sum()) if usual else 0
    return {"count": count, "times": away.max() / usual} if count else None


def unseen_points(s: Survey) -> Values:
    """The share of points in no picture, where some are in one."""
    seen, count = s.seen, len(s.points)
    if not seen.in_view.any() or seen.in_none <= UNSEEN * count:
        return None
    return {"none": seen.in_none / count, "behind": seen.behind_all / count}


RULES = (
    error("damaged-photo", lambda s: [{"why": look.error} for look in s.looks if look.error], "{why}"),
    warning(
        "few-photos",
        lambda s: len(s.names) < FEW_PHOTOS and {"count": len(s.names)},
        "There are only {count} photos. Many wrong scenes explain so few: new views will look torn.",
        "Take more photos that overlap: dozens of an object, hundreds of a building.",
    ),
    warning(
        "few-training-views",
        lambda s: len(s.train) < 2 and {"train": len(s.train), "held_out": len(s.held_out)},
        "Views to train on: {train}; held out: {held_out}.",
        "Hold out fewer: --pipeline.datamanager.dataparser.eval-interval, or eval-mode all.",
    ),
    warning(
        "duplicate-photos",
        copies,
        "Photos that exist under several names: {names}. {leaks}",
        "Keep one of each, and make the model again. A held-out copy makes scores too good.",
    ),
    warning(
        "blank-photos",
        photos(lambda look: look.error is None and not DARK <= look.brightness <= BRIGHT),
        "{count} black or white nearly all over: {names}.",
        "Look at them, and leave out those that show nothing.",
    ),
    warning(
        "exposure",
        exposures,
        "Photos differ in brightness by a factor of {factor:.1f}. If that is the camera's exposure, "
        "Gaussians in front of single cameras will imitate it as fog.",
        "Photograph with fixed exposure and white balance, even the photos out, or train with "
        "--pipeline.training.light affine.",
    ),
    note(
        "exif-orientation",
        photos(lambda look: look.orientation != 1),
        "{count} with an EXIF orientation: {names}. It is not applied, as COLMAP does not apply it.",
        "If another program made the poses and renderings come out turned, save the photos turned and "
        "without EXIF.",
    ),
    note(
        "large-photos",
        large,
        "Photos of up to {width} x {height} px are trained on, which takes long.",
        f"For a first result leave out {DOWNSCALE}: photos are then reduced to {MAX_AUTO_SIDE} px.",
    ),
    note(
        "photos-beyond-ram",
        beyond_ram,
        "Decoded photos take {needed}, of which {kept} are kept in RAM. The others are decoded again in each "
        "use, which takes time.",
        "Raise --pipeline.datamanager.photo-cache-gb if there is RAM, or reduce the photos.",
    ),
    warning(
        "far-cameras",
        far_cameras,
        "{count} far from the other cameras, up to {times:.0f} times as far from the middle: {names}. The "
        "scene is scaled until all cameras fit, so the rest of it becomes tiny.",
        "If they are registered wrongly, remove them from the model (`image_deleter` of the program colmap).",
    ),
    warning(
        "one-place",
        baseline,
        "The cameras lie within {extent:.3g} units, and what they show is {depth:.3g} units away. From one "
        "place no depth can be told.",
        "Move between photos, sideways too, by a tenth of the distance or more; do not only turn.",
    ),
    warning(
        "unlike-focal-lengths",
        fields,
        "In the model, {wide} is {ratio:.1f} times as wide as {narrow}. If one lens took both, the model is "
        "wrong.",
        "Make the model again with one camera for all photos (`abcd poses` without --several-lenses; of the "
        "program colmap `--ImageReader.single_camera 1`).",
    ),
    warning(
        "no-view-sees-points",
        lambda s: len(s.points) and not s.seen.in_view.any() and {"count": len(s.points)},
        "None of the {count:,} points lies in any picture. Points and cameras are of different models, or in "
        "different coordinates.",
        "Take both from one reconstruction. In transforms.json, ply_file_path must be in the coordinates of "
        "the frames.",
    ),
    warning(
        "views-without-points",
        views(lambda points: points == 0),
        "{count} without any point in the picture: {names}. Their poses are doubtful.",
        "Look at these photos. If they show the scene, make the model again, else remove them.",
    ),
    warning(
        "views-with-few-points",
        views(lambda points: (points > 0) & (points < FEW_POINTS_IN_VIEW)),
        f"{{count}} with fewer than {FEW_POINTS_IN_VIEW} points in the picture: {{names}}. Their poses may "
        "be inexact.",
        "See whether they are blurred or show little; more photos around them help.",
    ),
    warning(
        "few-points",
        lambda s: 0 < len(s.points) < FEW_POINTS and {"count": len(s.points)},
        "Number of points: {count}. Gaussians begin at points, so most surfaces begin without any.",
        "See whether the reconstruction is complete; more features and more matches give more points.",
    ),
    warning(
        "far-points",
        far_points,
        "{count:,} far from the other points, up to {times:,.0f} times as far from the middle as nine tenths "
        "of them. Each becomes a huge Gaussian.",
        "If they are no distant background, remove them (`point_filtering` of the program colmap).",
    ),
    warning(
        "unseen-points",
        unseen_points,
        "{none:.0%} of the points lie in no picture, {behind:.0%} behind every camera. No photo can correct "
        "Gaussians that begin there.",
        "If photos were taken away, fine. Else points and cameras are not of one model: take both from one.",
    ),
)
