"""Quality against the number of Gaussians: which arms of a study lie on which curve, and what they say."""

import itertools
import math
from collections.abc import Iterator, Sequence

from abcd_ns.lab.results.results import Arm, Results, find_default

NEAR_DB = 0.2
"""How far below the best a smaller number of Gaussians may be and still count as enough."""
PRICE, LIMIT, MCMC = "by price", "by limit", "MCMC"
"""The ways to a number: prices, the method's own among them; growth that is cut off at a limit; 3DGS-MCMC's
relocation up to a limit."""


def way_of(arm: Arm) -> str:
    """How the arm's number of Gaussians comes about."""
    if arm.variant == "default" or "training.density.price=" in arm.variant:
        return PRICE
    return MCMC if "training.density.strategy=mcmc" in arm.variant else LIMIT


def label_of(arm: Arm) -> str:
    """What is set, in a word or two."""
    if arm.variant == "default":
        return "as it is"
    name, number = arm.variant.rsplit("=", 1)
    if name.endswith("price"):
        return f"price {number}"
    limit = f"limit {int(number):,}" if number.isdecimal() else arm.variant
    return f"MCMC, {limit}" if way_of(arm) == MCMC else limit


def curves(results: Results) -> dict[str, list[Arm]]:
    """The arms of each way by their number of Gaussians."""
    arms = sorted(results.arms, key=lambda arm: arm.gaussians)
    found = {way: [arm for arm in arms if way_of(arm) == way] for way in (PRICE, LIMIT, MCMC)}
    return {way: arms for way, arms in found.items() if arms}


def fewest_near_best(arms: Sequence[Arm]) -> Arm:
    """The arm with the fewest Gaussians that is within NEAR_DB of the best."""
    best = max(arm.psnr for arm in arms)
    return min((arm for arm in arms if best - arm.psnr <= NEAR_DB), key=lambda arm: arm.gaussians)


def psnr_at(curve: Sequence[Arm], gaussians: float) -> float | None:
    """A curve's PSNR at a number of Gaussians, between its arms in the number's logarithm; None outside."""
    for left, right in itertools.pairwise(curve):
        if left.gaussians <= gaussians <= right.gaussians:
            width = math.log(right.gaussians / left.gaussians)
            share = math.log(gaussians / left.gaussians) / width if width > 0 else 0.0
            return left.psnr + share * (right.psnr - left.psnr)
    return None


def findings(results: Results) -> Iterator[str]:
    """What the study says, a sentence each."""
    if not results.arms:
        return
    best, fewest = max(results.arms, key=lambda arm: arm.psnr), fewest_near_best(results.arms)
    default = find_default(results)
    if default is not None:
        count = f"{default.gaussians:,.0f} Gaussians"
        yield f"As it is, {default.method} comes to {count} and {default.psnr:.2f} dB."
    yield (
        f"The fewest within {NEAR_DB:g} dB of the best measured ({label_of(best)}: {best.psnr:.2f} dB with "
        f"{best.gaussians:,.0f}) are {fewest.gaussians:,.0f} ({label_of(fewest)}: {fewest.psnr:.2f} dB)."
    )
    for way, arms in curves(results).items():
        if default is None or way == PRICE:
            continue
        psnr = psnr_at(arms, default.gaussians)
        if psnr is not None:
            difference = psnr - default.psnr
            yield f"{way}, with as many Gaussians as the method as it is: {psnr:.2f} dB ({difference:+.2f})."
