"""Made-up studies for tests of what `abcd study` writes. No number here was ever measured."""

import math
import random

from abcd_ns.lab.results.results import Arm, Results
from abcd_ns.lab.results.run import Run
from tests.lab.compare.records import made_up, made_up_run


def made_up_arm(variant: str, value: int | None, psnrs: dict[int, float], method="abcd", **fields) -> Arm:
    """An arm whose runs end at `psnrs`, by seed."""
    runs = (made_up_run(method, seed, psnr_merged=psnr, psnr=psnr, **fields) for seed, psnr in psnrs.items())
    return Arm(method, variant, value, tuple(runs))


def made_up_study(study: str, *arms: Arm, **fields) -> Results:
    """A study with these arms, and what it says."""
    return made_up(f"study of {study}", *arms, **fields)


def blocks_study(seeds: tuple[int, ...] = (0,)) -> Results:
    """A plausible study of blocks: slightly worse, smaller in memory and slower with more of them."""
    chance = random.Random(0)
    arms = []
    for count in (1, 2, 4, 8, 16, 27):
        psnr = 25.4 - 0.12 * math.log2(count)
        runs = tuple(_blocks_run(seed, count, psnr + chance.gauss(0, 0.1)) for seed in seeds)
        arms.append(Arm("abcd", f"blocks={count}", count, runs))
    return made_up_study("blocks", *arms, seeds=seeds)


def _blocks_run(seed: int, count: int, psnr: float) -> Run:
    return made_up_run(
        seed=seed,
        blocks=count,
        psnr_merged=psnr,
        psnr=psnr - 0.06 * math.log2(count),
        gaussians=int(38000 - 1500 * math.log2(count)),
        steps=int(2400 / (1 + 0.15 * math.log2(count))),
        peak_rss_bytes=int((1.1 + 1.4 / count) * 2**30),
    )


def gaussians_study(seeds: tuple[int, ...] = (0,)) -> Results:
    """A plausible frontier: prices above MCMC above limits, all levelling off."""
    chance = random.Random(1)
    density = "training.density"
    by_price = {price: int(30000 / (1 + price) ** 0.5) for price in (0, 1, 4, 16, 64)}
    ways = [("default", 12000, 0.0)]
    ways += [(f"{density}.price={price}", count, 0.0) for price, count in by_price.items()]
    ways += [(f"{density}.max_gaussians={limit}", limit, 0.8) for limit in (2000, 8000, 32000)]
    mcmc = f"{density}.strategy=mcmc {density}.max_gaussians="
    ways += [(f"{mcmc}{limit}", limit, 0.4) for limit in (2000, 8000, 32000)]
    arms = []
    for variant, count, behind in ways:
        psnrs = {seed: 26 - behind - 5 * (900 / count) ** 0.9 + chance.gauss(0, 0.03) for seed in seeds}
        arms.append(made_up_arm(variant, None, psnrs, gaussians=count, spz_bytes=16 * count))
    return made_up_study("gaussians", *arms, seeds=seeds)


def options_study(seeds: tuple[int, ...] = (0,)) -> Results:
    """A plausible ablation."""
    chance = random.Random(2)
    changes = {
        "default": 0.0,
        "training.warmup=0": -1.3,
        "training.batch=1": -0.45,
        "training.layers=false": -7.4,
        "training.visit_views=16": 0.08,
        "partition=grid blocks=27": -0.6,
        "training.density.strategy=mcmc": 0.5,
    }
    base = {seed: 24.0 + chance.gauss(0, 0.3) for seed in seeds}
    arms = [
        made_up_arm(name, None, {seed: base[seed] + gain + chance.gauss(0, 0.12) for seed in seeds})
        for name, gain in changes.items()
    ]
    return made_up_study("options", *arms, seeds=seeds)
