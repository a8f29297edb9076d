"""What is doubtful about the points that training begins with. Having none at all is the reader's to say."""

from collections.abc import Iterator

import numpy as np

from abcd_ns.cli.check.survey import Survey
from abcd_ns.cli.findings import Finding, note, warning
from abcd_ns.cli.terminal import many

FEW = 500
FAR_OFF = 100.0
"""A point this many times farther from the middle than nine tenths of the points are is far off."""
DIGITS = 1e5
"""Distance from the origin, in extents of the cameras, from which on float32 loses what a photo shows."""
UNSEEN = 0.05
"""Share of the points that may lie in no picture."""


def few_points(survey: Survey) -> Iterator[Finding]:
    """Too few to begin with."""
    count = len(survey.points)
    if 0 < count < FEW:
        yield warning(
            "few-points",
            f"There are only {many(count, 'point', 'points')}. Gaussians begin at points, so most surfaces "
            "begin with none.",
            "See whether the reconstruction is complete; more features and more matches give more points.",
        )


def far_points(survey: Survey) -> Iterator[Finding]:
    """Points far from all others."""
    if len(survey.points) < 10:
        return
    away = np.linalg.norm(survey.points - np.median(survey.points, axis=0), axis=1)
    usual = float(np.quantile(away, 0.9))
    far = away > FAR_OFF * usual
    if usual > 0 and far.any():
        yield warning(
            "far-points",
            f"{many(int(far.sum()), 'point lies', 'points lie')} far from the others, up to "
            f"{away.max() / usual:,.0f} times as far from the middle as nine tenths of them. Each becomes a "
            "huge Gaussian.",
            "If they are no distant background, remove them (`point_filtering` of the program colmap).",
        )


def unseen_points(survey: Survey) -> Iterator[Finding]:
    """Points in no picture, though some are in one."""
    count, seen = len(survey.points), survey.seen
    if not count or not survey.seen.in_view.any() or seen.in_none <= UNSEEN * count:
        return
    behind = f", {seen.behind_all / count:.0%} behind every camera" if seen.behind_all else ""
    yield warning(
        "unseen-points",
        f"{seen.in_none / count:.0%} of the points lie in no picture{behind}. No photo can correct what "
        "begins there. In a sound model each point was found in pictures.",
        "If photos were taken away, fine. Else points and cameras are not of one model: take both from one.",
    )


def far_origin(survey: Survey) -> Iterator[Finding]:
    """Geo-referenced coordinates."""
    extent = float(np.ptp(survey.centers, axis=0).max())
    away = float(np.linalg.norm(survey.centers.mean(axis=0)))
    if away > DIGITS * extent:
        yield note(
            "far-origin",
            f"The scene is {away:,.0f} units from the origin and {extent:,.3g} wide, as geo-referenced ones "
            "are. It is moved to the origin with full digits; programs that compute in float32 throughout "
            "would lose detail.",
        )


ALL = (few_points, far_points, unseen_points, far_origin)
