"""Held-out PSNR against one thing at a time: what the charts show."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.lab.results.results import Curve, Line
from abcd_ns.lab.stability.lab import PAIR, Lab, Method, Stage, make_stage
from abcd_ns.lab.stability.scenarios.captures import with_gains, with_noisy_poses
from abcd_ns.lab.stability.scenarios.schedules import BLOCKS, train_stale

VIEWS = (3, 8, 16)
VISIT_STEPS = (1, 4, 16, 64)
AGES = (1, 2, 4, 8)
"""Visits after which layers are refreshed."""
DEGREES = (0.0, 0.5, 1.0)
GAIN_STEPS = (1.0, 1.5, 2.0)
WITH_BLOCKS: tuple[Method, ...] = ("abcd", "abcd-ablated")

Train = Callable[[Lab], float]
"""Trains, and gives the held-out PSNR, dB."""


@dataclass(frozen=True)
class Study:
    """A curve to be made, point by point."""

    name: str
    title: str
    x_label: str
    points: tuple[tuple[str, float, Train], ...]
    """(line, x, what trains and scores)."""
    note: str = ""
    level: Train | None = None

    def __len__(self) -> int:
        return len(self.points) + (self.level is not None)

    def make(self, lab: Lab, advance: Callable[[], None] = lambda: None) -> Curve:
        """The curve; `advance` is called after each training."""

        def trained(train: Train) -> float:
            score = train(lab)
            advance()
            return score

        level = None if self.level is None else trained(self.level)
        found: dict[str, list[tuple[float, float]]] = {}
        for line, x, train in self.points:
            found.setdefault(line, []).append((x, trained(train)))
        lines = tuple(Line(name, *map(tuple, zip(*pairs, strict=True))) for name, pairs in found.items())
        return Curve(self.name, self.title, self.x_label, lines, self.note, level)


def studies() -> tuple[Study, ...]:
    """All of them, on the table with its balls."""
    stage = make_stage()
    clean = {method: _call(stage, method, name="table") for method in PAIR}
    return (*_of_training(stage, clean["abcd-monolithic"]), *_of_captures(stage, clean))


def _call(stage: Stage, method: Method, **options) -> Train:
    """Training and scoring that still waits for its lab."""
    return partial(Lab.compared, stage=stage, method=method, **options)


def _of_training(stage: Stage, one_block: Train) -> tuple[Study, ...]:
    blocks = [(m, k, _call(stage, m, blocks=k)) for m in WITH_BLOCKS for k in BLOCKS if k > 1]
    visits = [("abcd", n, _call(stage, "abcd", recipe=Recipe(visit_steps=n))) for n in VISIT_STEPS]
    damped = (("abcd", 1.0), ("abcd, damped by 1/2", 0.5))
    ages = [
        (name, age, partial(_stale, stage=stage, every=age, damping=share))
        for name, share in damped
        for age in AGES
    ]
    all_views = "4 blocks; the same number of views in all"
    allowed = "4 blocks, no density control; the engine itself allows 1 only"
    return (
        Study("blocks", "number of blocks", "blocks", tuple(blocks), level=one_block),
        Study(
            "visit-steps",
            "length of a visit",
            "steps a visit",
            tuple(visits),
            all_views,
            one_block,
        ),
        Study("staleness", "age of layers", "visits between refreshes", tuple(ages), allowed),
    )


def _of_captures(stage: Stage, clean: dict[Method, Train]) -> tuple[Study, ...]:
    def faults(changed: Callable[[float], Stage], values: tuple[float, ...], plain: float):
        """The points of both methods at all values, of which `plain` is the table as it is."""
        return tuple((m, x, clean[m] if x == plain else _call(changed(x), m)) for m in PAIR for x in values)

    views = faults(lambda n: stage.only(int(n)), VIEWS, VIEWS[-1])
    poses = faults(lambda d: with_noisy_poses(stage, d, 0.02 * d), DEGREES, 0.0)
    gains = faults(lambda g: with_gains(stage, (1.0, g)), GAIN_STEPS, 1.0)
    degrees = "degrees (and twice as many hundredths of the distance)"
    return (
        Study("views", "sparse views", "training views", views),
        Study("pose-noise", "noisy poses", degrees, poses),
        Study("exposure", "changing exposure", "gain of every other photo", gains),
    )


def _stale(lab: Lab, stage: Stage, every: int, **options) -> float:
    return train_stale(lab, stage, every, **options)[1]
