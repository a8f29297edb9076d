"""Held-out PSNR against one thing at a time: what the charts show."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from abcd_ns.tools.stability.captures import GAINS, MANY, with_gains, with_noisy_poses
from abcd_ns.tools.stability.freshness import BLOCKS, train_stale
from abcd_ns.tools.stability.lab import METHODS, Lab, Method, Stage, make_stage
from abcd_ns.tools.stability.world import ring

BUDGET = 1500
VIEWS = (3, 6, 12, 24)
VISIT_STEPS = (1, 4, 16, 64, 256)
AGES = (1, 2, 4, 8, 16)
"""Visits after which layers are refreshed."""
DEGREES = (0.0, 0.25, 0.5, 1.0)
GAIN_STEPS = (1.0, 1.25, 1.5, 2.0)
BITS = (16, 32)
WITH_BLOCKS: tuple[Method, ...] = ("abcd", "abcd-ablated")


@dataclass(frozen=True)
class Line:
    """One method's values."""

    name: str
    """The method, and after a comma how it differs."""
    x: tuple[float, ...]
    psnr: tuple[float, ...]


@dataclass(frozen=True)
class Curve:
    """One chart."""

    name: str
    title: str
    x_label: str
    lines: tuple[Line, ...]
    note: str = ""
    level: float | None = None
    """One block, where it does not depend on x; dB."""


@dataclass(frozen=True)
class Study:
    """A curve to be made, point by point."""

    name: str
    title: str
    x_label: str
    points: tuple[tuple[str, float, Callable[[Lab], float]], ...]
    """(line, x, what trains and scores)."""
    note: str = ""
    level: Callable[[Lab], float] | None = None

    def __len__(self) -> int:
        return len(self.points) + (self.level is not None)

    def make(self, lab: Lab) -> Iterator[Curve | None]:
        """Yields None after each training but the last, then the curve."""
        level = None if self.level is None else self.level(lab)
        if level is not None:
            yield None
        found: dict[str, list[tuple[float, float]]] = {}
        for number, (line, x, train) in enumerate(self.points, start=1):
            found.setdefault(line, []).append((x, train(lab)))
            if number < len(self.points):
                yield None
        lines = tuple(Line(name, *map(tuple, zip(*pairs, strict=True))) for name, pairs in found.items())
        yield Curve(self.name, self.title, self.x_label, lines, self.note, level)


def _score(lab: Lab, stage: Stage, method: Method, **options) -> float:
    return lab.train(stage, method, **{"budget": lab.views_drawn(BUDGET), **options}).psnr


def studies() -> tuple[Study, ...]:
    """All of them, on the table with its balls."""
    stage = make_stage(views=ring(MANY))
    return (*_studies_of_blocks(stage), *_studies_of_captures(stage))


_later = partial(partial, _score)
"""_later(stage=..., ...) is a call that still waits for its lab."""


def _studies_of_blocks(stage: Stage) -> tuple[Study, ...]:
    """What block training adds to joint training: cuts, visits, layers."""
    one_block = _later(stage=stage, method="abcd-monolithic")
    return (
        Study(
            "blocks",
            "number of blocks",
            "blocks",
            tuple(
                (m, k, _later(stage=stage, method=m, blocks=k)) for m in WITH_BLOCKS for k in BLOCKS if k > 1
            ),
            level=one_block,
        ),
        Study(
            "visit-steps",
            "length of a visit",
            "steps a visit (4 views each)",
            tuple(
                ("abcd", n, _later(stage=stage, method="abcd", blocks=4, visit_steps=n)) for n in VISIT_STEPS
            ),
            note="4 blocks; the same number of views in all",
            level=one_block,
        ),
        Study(
            "staleness",
            "age of layers",
            "visits between refreshes",
            tuple(
                (name, age, partial(_stale, stage=stage, every=age, **options))
                for name, options in (
                    ("abcd", {}),
                    ("abcd, damped by 1/2", {"damping": 0.5}),
                )
                for age in AGES
            ),
            note="4 blocks, no density control; the engine itself allows 1 only",
        ),
        Study(
            "layer-bits",
            "precision of layers",
            "bits",
            tuple(("abcd", bits, _later(stage=stage, method="abcd", bits=bits)) for bits in BITS),
            level=one_block,
        ),
    )


def _studies_of_captures(stage: Stage) -> tuple[Study, ...]:
    """What captures do to any method."""
    return (
        Study(
            "views",
            "sparse views",
            "training views",
            tuple((m, n, _later(stage=stage.only(n), method=m)) for m in METHODS for n in VIEWS),
        ),
        Study(
            "pose-noise",
            "noisy poses",
            "degrees (and twice as many hundredths of the distance)",
            tuple(
                (m, d, _later(stage=with_noisy_poses(stage, d, 0.02 * d), method=m))
                for m in METHODS
                for d in DEGREES
            ),
        ),
        Study(
            "exposure",
            "changing exposure",
            "gain of every other photo",
            tuple(
                (m, g, _later(stage=with_gains(stage, (GAINS[0], g)), method=m))
                for m in METHODS
                for g in GAIN_STEPS
            ),
        ),
    )


def _stale(lab: Lab, stage: Stage, every: int, **options) -> float:
    return train_stale(lab, stage, every, **options)[1]
