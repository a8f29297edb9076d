"""`abcd check`: look at a data set as training would, without training."""

import shlex
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from rich.console import Console

from abcd_ns.arguments import check_ranges
from abcd_ns.cli.check.survey import Survey, survey
from abcd_ns.cli.findings import Finding, error, note, print_findings, warning
from abcd_ns.data import DOWNSCALE, OPTION
from abcd_ns.data.input_errors import InputError, one_line
from abcd_ns.data.photos import default_budget
from abcd_ns.data.scene import Lens
from abcd_ns.engine.train.memory import parameter_bytes
from abcd_ns.terminal import few, print_facts, print_plain
from abcd_ns.units import bytes_in_words

MIDDLE = (0.05, 0.95)
"""Quantiles between which the points' extent is taken: single wrong ones would decide it otherwise."""
FEW_PHOTOS, FEW_POINTS, FEW_POINTS_IN_VIEW = 8, 500, 20
DARK, BRIGHT = 0.02, 0.98  # mean luma beyond which a photo shows nothing
EXPOSURES = 3.0
"""Largest ratio of mean lumas, the brightest and darkest twentieth left out, that one exposure explains. A
room with windows (bonsai, of Mip-NeRF 360) has 2.3."""
SMALL_BASELINE = 0.02  # extent of the cameras, as a share of the median depth, below which depth is a guess
FAR_CAMERA, FAR_POINT = 10.0, 100.0
"""Distance from the middle, by that of three quarters of the cameras or of nine tenths of the points."""
FIELDS = 3.0  # ratio of angles of view beyond which one of them is doubtful
UNSEEN = 0.05  # share of the points that may lie in no picture


def check(*, data: Path, downscale: int | None = None) -> int:
    """Examine a data set before training. Say what is wrong or doubtful, and what to do about it.

    abcd check --data garden

    Reads the data as `ns-train abcd` does, then decodes every photo. Writes nothing. The exit code is 2
    if training would refuse the data.

    Args:
        data: Folder with photos and a COLMAP model or a transforms.json, as for `ns-train abcd --data`.
        downscale: Divides the photos' width and height. Left out, no side is over 1600 px, as in training.
    """
    check_ranges({"downscale": downscale})
    found, findings = examine(data, downscale)
    console, levels = Console(), {finding.level for finding in findings}
    if found is not None:
        print_facts(summary(found), console)
    print_findings(findings, console)
    name, reduced = one_line(str(data)), f" {DOWNSCALE} {downscale}" if downscale else ""
    if "error" in levels:
        verdict = f"Training cannot work with {name}: fix the errors first."
    elif "warning" in levels:
        verdict = f"{name} can be trained on; see whether the warnings matter to you."
    else:
        verdict = f"{name} is fine: ns-train abcd --data {shlex.quote(name)}{reduced}"
    print_plain(f"\n{verdict}", console)
    return 2 if "error" in levels else 0


def examine(data: Path, downscale: int | None = None) -> tuple[Survey | None, list[Finding]]:
    """The scene, None where training would refuse it, and what was found."""
    try:
        found = survey(data, downscale)
    except InputError as refused:
        return None, [error("input", line) for line in refused.lines]
    own = [warning("input", said) for said in found.prepared.scene.notes]
    own += [note("input", said) for said in found.prepared.chosen]
    return found, [*own, *doubts(found)]


def summary(s: Survey) -> dict[str, str]:
    """A scene in a dozen numbers; lengths are in the units of the model, but for one of the near plane."""
    sources, scene, scale = s.prepared.sources, s.prepared.scene, s.prepared.similarity.scale
    masks, alpha = sum(bool(source.mask_path) for source in sources), sum(look.alpha for look in s.looks)
    more = [f"{count:,} with {what}" for count, what in ((masks, "a mask"), (alpha, "alpha")) if count]
    photos, budget = bytes_in_words(s.photo_bytes), default_budget()
    if s.photo_bytes > budget:
        photos = f"{bytes_in_words(budget)} of {photos}"
    extent = ""
    if len(s.points):
        low, high = np.quantile(s.points, MIDDLE, axis=0)
        extent = f", nine tenths of them within {_box(high - low)}"
    gaussians = bytes_in_words(len(s.points) * parameter_bytes(sh_degree=3))
    sizes = _counted("{} x {} px".format(*source.size) for source in sources)
    return {
        "model": one_line(str(scene.model)),
        "photos": ", ".join([f"{len(s.names):,}", sizes, *more]),
        "lenses": _counted(_in_words(frame.lens) for frame in scene.frames),
        "views": f"{len(s.train):,} to train on, {len(s.held_out):,} held out",
        "cameras": f"within {_box(np.ptp(s.centers, axis=0))} model units",
        "points": f"{len(s.points):,}{extent}",
        "near plane": f"{s.near / scale:.3g} model units, {s.near:.3g} in training",
        "RAM": f"{photos} of photos, {gaussians} of Gaussians to begin with",
    }


def _in_words(lens: Lens) -> str:
    kind = "fisheye" if lens.fisheye else "distorted" if lens.distorted else "pinhole"
    angle = 2 * np.degrees(np.arctan(lens.width / (2 * lens.fx)))
    wide = "" if lens.fisheye else f", {angle:.0f} degrees wide"
    return f"{kind}, {lens.width} x {lens.height}, f {lens.fx:.0f} px{wide}"


def _counted(found: Iterable[str]) -> str:
    """What there is, with how often where it is not all the same."""
    counts = Counter(found).most_common()
    return counts[0][0] if len(counts) == 1 else few([f"{count} of {what}" for what, count in counts])


def _box(sides: np.ndarray) -> str:
    return " x ".join(f"{float(f'{side:.3g}'):,.12g}" for side in sides)


def doubts(s: Survey) -> Iterator[Finding]:
    """All that is wrong or doubtful."""
    yield from _of_the_set(s)
    yield from _of_single_photos(s)
    yield from _of_cameras(s)
    yield from _of_points(s)


def _of_the_set(s: Survey) -> Iterator[Finding]:
    if len(s.names) < FEW_PHOTOS or len(s.train) < 2:
        yield warning(
            "few-photos",
            f"There are only {len(s.names)} photos, {len(s.train)} of them to train on. Many wrong scenes "
            "explain so few: new views will look torn.",
            "Take more photos that overlap: dozens of an object, hundreds of a building. Or hold out fewer: "
            f"{OPTION}eval-interval, or {OPTION}eval-mode all.",
        )
    if s.copies:
        held_out = set(s.held_out)
        leaks = sum(0 < len(held_out & set(rows)) < len(rows) for rows in s.copies)
        names = few([" = ".join(s.names[row] for row in rows) for rows in s.copies])
        both = f" Both trained on and held out: {leaks}." if leaks else ""
        fix = "Keep one of each, and make the model again. A held-out copy makes scores too good."
        yield warning("duplicate-photos", f"Photos that exist under several names: {names}.{both}", fix)
    lumas = np.array([look.brightness for look in s.looks if look.error is None])
    lumas = lumas[(lumas > DARK) & (lumas < BRIGHT)]
    low, high = np.quantile(lumas, [0.05, 0.95]) if len(lumas) >= FEW_PHOTOS else (1.0, 1.0)
    if high > EXPOSURES * low:
        yield warning(
            "exposure",
            f"Photos differ in brightness by a factor of {high / low:.1f}. If that is the camera's exposure, "
            "Gaussians in front of single cameras will imitate it as fog.",
            "Photograph with fixed exposure and white balance, even the photos out, or train with "
            "--pipeline.training.light affine.",
        )
    needed, budget = s.photo_bytes, default_budget()
    if needed > budget:
        yield note(
            "photos-beyond-ram",
            f"Decoded photos take {bytes_in_words(needed)}, of which {bytes_in_words(budget)} are kept in "
            "RAM. The others are decoded again in each use, which takes time.",
            "Raise --pipeline.datamanager.photo-cache-gb if there is RAM, or reduce the photos.",
        )


def _of_single_photos(s: Survey) -> Iterator[Finding]:
    looks = list(zip(s.names, s.looks, strict=True))
    for look in s.looks:
        if look.error:
            yield error("damaged-photo", look.error)
    blank = [name for name, look in looks if not look.error and not DARK <= look.brightness <= BRIGHT]
    if blank:
        fix = "Look at them, and leave out those that show nothing."
        yield warning("blank-photos", f"{len(blank)} black or white nearly all over: {few(blank)}.", fix)
    turned = [name for name, look in looks if look.orientation != 1]
    if turned:
        yield note(
            "exif-orientation",
            f"{len(turned)} with an EXIF orientation: {few(turned)}. It is not applied, as COLMAP does not "
            "apply it.",
            "If another program made the poses and renderings come out turned, save the photos turned and "
            "without EXIF.",
        )


def _of_cameras(s: Survey) -> Iterator[Finding]:
    away, usual = _distances(s.centers, 0.75)
    far = [s.names[row] for row in np.flatnonzero(away > FAR_CAMERA * usual)] if usual else []
    if far:
        yield warning(
            "far-cameras",
            f"{len(far)} far from the other cameras, up to {away.max() / usual:.0f} times as far from the "
            f"middle: {few(far)}. The scene is scaled until all cameras fit, so the rest of it becomes tiny.",
            "If they are registered wrongly, remove them from the model (`image_deleter` of the program "
            "colmap).",
        )
    extent, depths = float(np.ptp(s.centers, axis=0).max()), s.seen.depth[np.isfinite(s.seen.depth)]
    depth = float(np.median(depths)) if len(depths) else 0.0
    if extent < SMALL_BASELINE * depth:
        yield warning(
            "one-place",
            f"The cameras lie within {extent:.3g} units, and what they show is {depth:.3g} units away. From "
            "one place no depth can be told.",
            "Move between photos, sideways too, by a tenth of the distance or more; do not only turn.",
        )
    wide = np.array([lens.width / lens.fx for lens in s.prepared.lenses])
    if wide.max() > FIELDS * wide.min():
        widest, narrowest = (s.names[int(row)] for row in (wide.argmax(), wide.argmin()))
        yield warning(
            "unlike-focal-lengths",
            f"In the model, {widest} is {wide.max() / wide.min():.1f} times as wide as {narrowest}. If one "
            "lens took both, the model is wrong.",
            "Make the model again with one camera for all photos (`abcd poses` without --several-lenses; of "
            "the program colmap `--ImageReader.single_camera 1`).",
        )


def _of_points(s: Survey) -> Iterator[Finding]:
    count, in_view = len(s.points), s.seen.in_view
    if 0 < count < FEW_POINTS:
        what = f"Only {count} points. Gaussians begin at points, so most surfaces begin without any."
        fix = "See whether the reconstruction is complete; more features and more matches give more points."
        yield warning("few-points", what, fix)
    if s.seen.in_none > UNSEEN * count:
        yield (error if s.seen.in_none == count else warning)(
            "unseen-points",
            f"{s.seen.in_none / count:.0%} of the points lie in no picture, {s.seen.behind_all / count:.0%} "
            "behind every camera. No photo can correct Gaussians that begin there.",
            "If photos were taken away, fine. Else points and cameras are not of one model: take both from "
            "one. In transforms.json, ply_file_path must be in the coordinates of the frames.",
        )
    sparse = np.flatnonzero(in_view < FEW_POINTS_IN_VIEW) if in_view.any() else []
    if len(sparse):
        names = few([f"{s.names[row]} ({in_view[row]:.0f})" for row in sparse])
        what = f"{len(sparse)} with fewer than {FEW_POINTS_IN_VIEW} points in the picture: {names}."
        fix = "See whether they are blurred or show little. Without any point they are likely misplaced."
        yield warning("views-with-few-points", f"{what} Their poses may be inexact.", fix)
    away, usual = _distances(s.points, 0.9) if count >= 10 else (np.zeros(1), 0.0)
    if usual and (far := int((away > FAR_POINT * usual).sum())):
        yield warning(
            "far-points",
            f"{far:,} far from the other points, up to {away.max() / usual:,.0f} times as far from the "
            "middle as nine tenths of them. Each becomes a huge Gaussian.",
            "If they are no distant background, remove them (`point_filtering` of the program colmap).",
        )


def _distances(places: np.ndarray, share: float) -> tuple[np.ndarray, float]:
    """From the middle of the places, and within which of them this share lies."""
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    return away, float(np.quantile(away, share, method="lower"))
