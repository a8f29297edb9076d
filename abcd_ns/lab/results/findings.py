"""What an experiment says: the gap of best and worst, differences to the default, growth."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from abcd_ns.lab.results import frontier
from abcd_ns.lab.results.results import Arm, Outcome, Results, find_default

GOAL_DB = 0.5
"""Between the best and the worst number of blocks, no more than this: no cliff."""
GOAL_GROWTH = 0.05
"""Growth of peak memory that is allowed from the smallest scene to the largest."""


@dataclass(frozen=True)
class Difference:
    """An arm against the default, seed by seed, dB."""

    by_seed: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Over the seeds that both have."""
        return fmean(self.by_seed)

    @property
    def deviation(self) -> float | None:
        """Standard deviation over the seeds (n - 1); None for a single one."""
        return None if len(self.by_seed) < 2 else stdev(self.by_seed)


def best_and_worst(arms: Sequence[Arm]) -> tuple[Arm, Arm] | None:
    """By PSNR; None with fewer than two arms."""
    if len(arms) < 2:
        return None
    return max(arms, key=lambda arm: arm.psnr), min(arms, key=lambda arm: arm.psnr)


def find_growth(results: Results, name: str) -> float | None:
    """A field of ABCD's runs, largest scene by smallest, less 1; None where fewer than two are known."""
    sizes = [getattr(arm.runs[0], name) for arm in results.of("abcd")]
    return sizes[-1] / sizes[0] - 1 if len(sizes) > 1 and sizes[0] and sizes[-1] else None


def find_difference(arm: Arm, default: Arm) -> Difference | None:
    """The arm against the default; None where no seed has both."""
    theirs = {run.seed: run.psnr_merged for run in default.runs}
    pairs = [run.psnr_merged - theirs[run.seed] for run in arm.runs if run.seed in theirs]
    return Difference(tuple(pairs)) if pairs else None


def find_differences(results: Results) -> list[tuple[Arm, Difference]]:
    """Every other arm against the default; those that share no seed with it are left out."""
    default = find_default(results)
    if default is None:
        return []
    found = ((arm, find_difference(arm, default)) for arm in results.arms if arm is not default)
    return [(arm, difference) for arm, difference in found if difference is not None]


def findings_of(results: Results) -> tuple[str, ...]:
    """What the experiment says, a sentence each."""
    find = {
        "study of blocks": _of_blocks,
        "study of gaussians": frontier.findings,
        "study of options": _of_options,
        "study of scale": _of_scale,
        "stability report": _of_outcomes,
    }.get(results.kind)
    return tuple(find(results)) if find else ()


def _of_blocks(results: Results) -> tuple[str, ...]:
    found = best_and_worst(results.arms)
    if found is None:
        return ()
    (best, worst), gap = found, found[0].psnr - found[1].psnr
    verdict = "within" if gap <= GOAL_DB else "above"
    return (
        f"Best: {_blocks(best)}, {best.psnr:.2f} dB. Worst: {_blocks(worst)}, {worst.psnr:.2f} dB. "
        f"Gap: {gap:.2f} dB, {verdict} the {GOAL_DB:g} dB of the goal.",
    )


def _of_options(results: Results) -> tuple[str, ...]:
    default = find_default(results)
    if default is None:
        return ("There is nothing to compare with: the default's runs failed.",)
    known = [(arm, difference.mean) for arm, difference in find_differences(results)]
    if not known:
        return ()
    best, worst = (pick(known, key=lambda pair: pair[1]) for pick in (max, min))
    text = f"Best change: {best[0].variant}, {best[1]:+.2f} dB."
    if best[1] <= 0:
        text = f"No change is better than the default; nearest: {best[0].variant}, {best[1]:+.2f} dB."
    if best[0] is not worst[0]:
        text += f" Worst: {worst[0].variant}, {worst[1]:+.2f} dB."
    if len(default.runs) < 2:
        text += " One seed: differences of a few tenths of a dB may be chance."
    return (text,)


def _of_scale(results: Results) -> tuple[str, ...]:
    arms, ram = results.of("abcd"), find_growth(results, "peak_rss_bytes")
    if ram is None:
        return ()
    device = find_growth(results, "peak_device_bytes")
    more = "" if device is None else f", GPU memory by {device:.1%}"
    return (
        f"From {arms[0].value} to {arms[-1].value} blocks of ABCD, peak RAM grows by {ram:.1%}{more}; "
        f"allowed: {GOAL_GROWTH:.0%}.",
    )


def _of_outcomes(results: Results) -> tuple[str, ...]:
    return (headline(results.outcomes),) if results.outcomes else ()


def headline(outcomes: Sequence[Outcome]) -> str:
    """One sentence about all of them."""
    passed = sum(outcome.passed for outcome in outcomes)
    failed = [outcome.id for outcome in outcomes if not outcome.passed]
    worse = [outcome.id for outcome in outcomes if outcome.worse]
    text = f"{passed} of {len(outcomes)} scenarios pass"
    text += f"; these fail: {', '.join(failed)}" if failed else ""
    return text + (f"; one block does better, by however little, in {', '.join(worse)}." if worse else ".")


def _blocks(arm: Arm) -> str:
    return "1 block" if arm.value == 1 else f"{arm.value} blocks"
