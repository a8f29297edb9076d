"""What an experiment says, a sentence each."""

from collections.abc import Iterator, Mapping, Sequence

from abcd_ns.lab.results.results import TERRAIN, Arm, Outcome, Results

NEAR_DB = 0.2
"""How far below the best fewer Gaussians may be and still count as enough."""
GOAL_GROWTH = 0.05
"""Growth of peak memory that is allowed from the smallest scene to the largest."""


def findings_of(results: Results) -> tuple[str, ...]:
    """Best and worst arm of each method, or the growth of memory, or the scenarios that pass."""
    if results.outcomes:
        return (headline(results.outcomes),)
    if results.kind == TERRAIN:
        return tuple(_of_growth(results))
    several = (arms for arms in map(results.of, results.methods) if len(arms) > 1)
    return tuple(_of_arms(arms, results.labels) for arms in several)


def find_growth(results: Results, name: str) -> float | None:
    """A field of ABCD's runs, largest scene by smallest, less 1; None where fewer than two are known."""
    sizes = [getattr(arm.runs[0], name) for arm in results.of("abcd")]
    return sizes[-1] / sizes[0] - 1 if len(sizes) > 1 and sizes[0] and sizes[-1] else None


def headline(outcomes: Sequence[Outcome]) -> str:
    """One sentence about all scenarios."""
    passed = sum(outcome.passed for outcome in outcomes)
    failed = [outcome.id for outcome in outcomes if not outcome.passed]
    worse = [outcome.id for outcome in outcomes if outcome.worse]
    text = f"{passed} of {len(outcomes)} scenarios pass"
    text += f"; these fail: {', '.join(failed)}" if failed else ""
    return text + (f"; one block does better, by however little, in {', '.join(worse)}." if worse else ".")


def _of_arms(arms: Sequence[Arm], labels: Mapping[str, str]) -> str:
    best, worst = (pick(arms, key=lambda arm: arm.psnr) for pick in (max, min))
    fewest = min((arm for arm in arms if best.psnr - arm.psnr <= NEAR_DB), key=lambda arm: arm.gaussians)
    return (
        f"Best: {labels[best.name]}, {best.psnr:.2f} dB. Worst: {labels[worst.name]}, {worst.psnr:.2f} dB. "
        f"Gap: {best.psnr - worst.psnr:.2f} dB. Fewest Gaussians within {NEAR_DB:g} dB of the best: "
        f"{fewest.gaussians:,.0f} ({labels[fewest.name]}, {fewest.psnr:.2f} dB)."
    )


def _of_growth(results: Results) -> Iterator[str]:
    ram, device = (find_growth(results, name) for name in ("peak_rss_bytes", "peak_device_bytes"))
    if ram is not None:
        arms, more = results.of("abcd"), "" if device is None else f", GPU memory by {device:.1%}"
        yield (
            f"From {arms[0].value} to {arms[-1].value} blocks of ABCD, peak RAM grows by {ram:.1%}{more}; "
            f"allowed: {GOAL_GROWTH:.0%}."
        )
