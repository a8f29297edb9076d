"""A run's log, read back: what happened when."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from abcd_ns.lab.results.records import RecordError, decode
from abcd_ns.nerfstudio.run.log_lines import (
    KINDS,
    SCHEMA,
    EndLine,
    HeldOutLine,
    Line,
    SampleLine,
    ShedAtEndLine,
    SweepEndLine,
    TrainingLine,
    VisitEndLine,
    VisitLine,
    WorkerLine,
    layer_share,
)

L = TypeVar("L", bound=Line)


@dataclass(frozen=True)
class Visit:
    """One visit, from its first line and its last."""

    number: int
    sweep: int
    block: int | None
    """None for the warm-up."""
    began: float
    """Training time, s; likewise `ended`."""
    ended: float
    done: bool
    """False where the log ends within the visit."""
    layer_seconds: float = 0.0
    psnr: float | None = None
    """Of its later half, on training crops, dB."""

    @property
    def seconds(self) -> float:
        """How long it took, or has taken so far."""
        return self.ended - self.began


@dataclass(frozen=True)
class Story:
    """All of a log."""

    trainings: tuple[TrainingLine, ...]
    """Where training began, and where it was resumed; at least one."""
    samples: tuple[SampleLine, ...]
    visits: tuple[Visit, ...]
    ended: tuple[VisitEndLine, ...]
    """The last lines of visits that ended."""
    sweeps: tuple[SweepEndLine, ...]
    held_out: tuple[HeldOutLine, ...]
    """Those with a PSNR."""
    workers: tuple[WorkerLine, ...]
    """At the end; none where one process trained."""
    shed_at_end: ShedAtEndLine | None
    """The last; None where the run is not complete, or nothing was pruned."""
    end: EndLine | None
    """None where the run goes on, or was killed."""
    moments: tuple[tuple[int, float], ...]
    """(step, training time) of every line."""
    blocks: int
    """Their number, as far as is known: one that is split off during a run has the next number."""

    @property
    def step(self) -> int:
        """The last that is known of."""
        return self.moments[-1][0]

    @property
    def seconds(self) -> float:
        """Of training, as far as is known."""
        return self.moments[-1][1]

    def seconds_at(self, step: int) -> float:
        """Training time at a step, interpolated between the lines."""
        steps, seconds = zip(*self.moments, strict=True)
        return float(np.interp(step, steps, seconds))

    @property
    def gaussians(self) -> int:
        """In the whole scene, when last counted."""
        known = [self.trainings[-1], *self.samples[-1:], *([self.end] if self.end else [])]
        return known[-1].gaussians

    @property
    def layer_share(self) -> float:
        """Of the time of all visits that ended, the share for drawing layers."""
        return layer_share(self.ended)

    def of_block(self, block: int) -> tuple[Visit, ...]:
        """The visits to one block."""
        return tuple(visit for visit in self.visits if visit.block == block)


def read_story(path: Path) -> Story:
    """Read a log.

    A last line without its end, as a kill leaves it, is passed over.

    Raises:
        RecordError: the file is absent, or a line is none of a log's; the message names it.
    """
    try:
        texts = path.read_bytes().decode("utf-8", "replace").split("\n")[:-1]
    except FileNotFoundError:
        raise RecordError(f"{path} does not exist; runs of this version of abcd_ns write it.") from None
    except OSError as error:
        raise RecordError(f"{path} cannot be read: {error.strerror}.") from None
    lines = [_read_line(text, f"{path}, line {number}") for number, text in enumerate(texts, start=1)]
    if not any(isinstance(line, TrainingLine) for line in lines):
        raise RecordError(f"{path} does not say when training began; it is not the log of a run.")
    trainings, visits = _of(lines, TrainingLine), tuple(_join_visits(lines))
    return Story(
        trainings=trainings,
        samples=_of(lines, SampleLine),
        visits=visits,
        ended=_of(lines, VisitEndLine),
        sweeps=_of(lines, SweepEndLine),
        workers=_of(lines, WorkerLine),
        held_out=tuple(line for line in _of(lines, HeldOutLine) if line.psnr is not None),
        shed_at_end=next(reversed(_of(lines, ShedAtEndLine)), None),
        end=next(reversed(_of(lines, EndLine)), None),
        moments=tuple((line.step, line.seconds) for line in lines),
        blocks=max([trainings[-1].blocks, *(1 + v.block for v in visits if v.block is not None)]),
    )


def _of(lines: Iterable[Line], kind: type[L]) -> tuple[L, ...]:
    return tuple(line for line in lines if isinstance(line, kind))


def _read_line(text: str, where: str) -> Line:
    try:
        data = json.loads(text, parse_constant=_refuse)
    except ValueError as error:
        raise RecordError(f"{where} is damaged ({error}); remove it to see the rest.") from None
    kind = data.pop("kind", None) if isinstance(data, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise RecordError(f"{where} is of the unknown kind {kind!r}; another version of abcd_ns wrote it.")
    line = decode(KINDS[kind], data, where)
    if isinstance(line, TrainingLine) and line.schema != SCHEMA:
        raise RecordError(f"{where} has schema {line.schema}; this version of abcd reads schema {SCHEMA}.")
    return line


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no number in JSON")


def _join_visits(lines: list[Line]) -> Iterator[Visit]:
    begun = {line.visit: line for line in _of(lines, VisitLine)}
    over = {line.visit: line for line in _of(lines, VisitEndLine)}
    for number in sorted({*begun, *over}):
        first, last = begun.get(number), over.get(number)
        if last is None:
            yield Visit(number, first.sweep, first.block, first.seconds, lines[-1].seconds, done=False)
            continue
        # A resumed run whose past is lost has visits without a beginning.
        began = first.seconds if first else last.seconds - last.visit_seconds
        yield Visit(number, last.sweep, last.block, began, last.seconds, True, last.layer_seconds, last.psnr)
