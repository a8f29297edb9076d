"""A13, A19: old layers, and what the number of blocks and the length of visits decide."""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

from abcd_ns.engine.events import VisitEnded
from abcd_ns.engine.space.partition import build_grid
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.lab.stability.lab import BUDGET, STILL, Lab, Stage, make_stage
from abcd_ns.lab.stability.outcome import Finding, db, scenario
from abcd_ns.lab.stability.scenarios.stale import stale_coordinator
from abcd_ns.lab.world.world import ring

BLOCKS = (1, 2, 4, 8, 27)
CLIFF_DB = 0.5
VISITS_RISING = 0.05
RISES_BY = 1e-3
"""A visit raised the objective if by more than this share of it."""
SWEEP = 4
"""Blocks, and so visits in a sweep, of the runs with old layers."""


def objectives(lab: Lab, stage: Stage, coordinator: Coordinator) -> list[float]:
    """Train to the end; the error over all training photos at the start and after each visit."""
    found = [lab.error(coordinator, stage)]

    def listen(event) -> None:
        if isinstance(event, VisitEnded):
            found.append(lab.error(coordinator, stage))

    coordinator.announce.subscribe(listen)
    lab.finish(coordinator, stage)
    return found


def share_rising(errors: Sequence[float]) -> float:
    """The share of visits that raised the objective."""
    rises = [after > (1 + RISES_BY) * before for before, after in pairwise(errors)]
    return sum(rises) / len(rises)


def train_stale(lab: Lab, stage: Stage, every: int, *, damping: float = 1.0) -> tuple[float, float]:
    """(share of visits that raised the objective, held-out PSNR) with layers up to `every` visits old."""
    coordinator = lab.coordinator(
        stage.start(),
        stage.views,
        budget=lab.views_drawn(BUDGET // 2),
        blocks=SWEEP,
        warmup=0.0,
        density=STILL,
        heal=False,
        passes=2,
        kind=partial(stale_coordinator, every=every, damping=damping),
    )
    rising = share_rising(objectives(lab, stage, coordinator))
    return rising, lab.score(coordinator, stage)


@scenario(
    "A13",
    "old layers oscillate and diverge",
    "layers drawn anew for each visit; once a sweep; once a sweep, damped",
    f"fresh, and damped, the full objective rises in at most {VISITS_RISING:.0%} of visits",
    cost=4,
)
def old_layers(lab: Lab) -> Finding:
    """A13: a refresh left out, and refreshes once a sweep with and without damping."""
    stage, numbers, said = make_stage(views=ring(12), points=400), {}, {}
    cases = {
        "abcd": {"every": 1},
        "once a sweep": {"every": SWEEP},
        "once a sweep, damped": {"every": SWEEP, "damping": 0.5},
    }
    for name, options in cases.items():
        rising, score = train_stale(lab, stage, **options)
        numbers |= {f"rising {name}": rising, f"psnr {name}": score}
        said[name] = f"{rising:.0%} of visits raised the objective, {db(score)}"
    damped = numbers["rising once a sweep, damped"] <= VISITS_RISING
    return Finding(damped and numbers["rising abcd"] <= VISITS_RISING, said, numbers)


@scenario(
    "A19",
    "the number of blocks and of steps a visit decide the quality",
    f"{', '.join(map(str, BLOCKS))} blocks and a grid that cuts the balls, on a budget of 600 views",
    f"worst within {CLIFF_DB} dB of the best; the charts show visits of 1 to 64 steps too",
    cost=6,
)
def blocks_and_cuts(lab: Lab) -> Finding:
    """A19: the defaults with 1 to 27 blocks, and with a grid whose planes cut every ball."""
    stage = make_stage()
    psnr = {"1 block": lab.compared(stage, "abcd-monolithic", "table")}
    psnr |= {f"{k} blocks": lab.compared(stage, "abcd", blocks=k) for k in BLOCKS if k > 1}
    cut = build_grid(stage.start().means.clamp(-0.5, 0.5), counts=(2, 2, 1))
    psnr["4 that cut the balls"] = lab.compared(stage, "abcd", tree=cut)
    gap = max(psnr.values()) - min(psnr.values())
    behind = psnr["1 block"] - min(psnr.values())
    said = {"abcd": ", ".join(f"{name} {value:.2f}" for name, value in psnr.items()) + " dB"}
    said["abcd-monolithic"] = db(psnr["1 block"])
    numbers = {**{f"psnr {name}": value for name, value in psnr.items()}, "best to worst": gap}
    return Finding(gap <= CLIFF_DB, said, numbers, worse=behind > 0)
