"""`abcd check`: look at a data set as training would, without training."""

import shlex
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rich.console import Console

from abcd_ns.cli.check.rules import doubts
from abcd_ns.cli.check.survey import Survey, survey
from abcd_ns.cli.findings import Finding, by_level, error, note, print_findings, warning
from abcd_ns.cli.terminal import few, print_facts, print_plain
from abcd_ns.data.input_errors import InputError, one_line
from abcd_ns.data.photos import default_budget
from abcd_ns.data.prepare import DOWNSCALE
from abcd_ns.data.scene import Lens
from abcd_ns.engine.train.memory import parameter_bytes
from abcd_ns.lab.runs.options import check_ranges
from abcd_ns.units import bytes_in_words

REFUSED = 2
"""Exit code where training would refuse the data."""
MIDDLE = (0.05, 0.95)
"""Quantiles between which the points' extent is taken: single wrong ones would decide it otherwise."""


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
    return REFUSED if "error" in levels else 0


def examine(data: Path, downscale: int | None = None) -> tuple[Survey | None, tuple[Finding, ...]]:
    """The scene, None where training would refuse it, and what was found, the most serious first."""
    try:
        found = survey(data, downscale)
    except InputError as refused:
        return None, tuple(error("input", line) for line in refused.lines)
    own = [warning("input", said) for said in found.prepared.notes]
    own += [note("input", said) for said in found.prepared.chosen]
    return found, by_level([*own, *doubts(found)])


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
