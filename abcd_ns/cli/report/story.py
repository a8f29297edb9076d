"""The log of a run, read back."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np

from abcd_ns.lab.results.records import RecordError, decode
from abcd_ns.nerfstudio.run.log_lines import (
    KINDS,
    SCHEMA,
    CutAnewLine,
    EndLine,
    HeldOutLine,
    Line,
    SampleLine,
    TrainingLine,
    VisitEndLine,
    VisitLine,
)

L = TypeVar("L", bound=Line)


@dataclass(frozen=True)
class Story:
    """All of a log."""

    lines: tuple[Line, ...]
    blocks: int  # their number, as far as is known: one that is split off during a run has the next number

    def of(self, kind: type[L]) -> tuple[L, ...]:
        return tuple(line for line in self.lines if isinstance(line, kind))

    def last(self, kind: type[L]) -> L | None:
        return next(reversed(self.of(kind)), None)

    @property
    def visits(self) -> tuple[VisitEndLine, ...]:
        """Those that ended, the warm-up's among them."""
        return self.of(VisitEndLine)

    @property
    def held_out(self) -> tuple[HeldOutLine, ...]:
        """Those with a PSNR."""
        return tuple(line for line in self.of(HeldOutLine) if line.psnr is not None)

    @property
    def end(self) -> Line:
        """Up to where the run is known."""
        return self.lines[-1]

    def seconds_at(self, step: int) -> float:
        """Training time at a step, interpolated between the lines."""
        steps, seconds = zip(*((line.step, line.seconds) for line in self.lines), strict=True)
        return float(np.interp(step, steps, seconds))

    @property
    def gaussians(self) -> int:
        """In the whole scene, when last counted."""
        return (self.last(EndLine) or self.last(SampleLine) or self.last(TrainingLine)).gaussians

    @property
    def since_cut(self) -> "Story":
        """What came since the scene was cut anew, if it was: blocks have other numbers since."""
        last = max((row for row, line in enumerate(self.lines) if isinstance(line, CutAnewLine)), default=0)
        return replace(self, lines=self.lines[last:])

    def of_block(self, block: int) -> tuple[VisitEndLine, ...]:
        """The visits to one block that ended, since blocks have had their numbers."""
        return tuple(visit for visit in self.since_cut.visits if visit.block == block)


def read_story(path: Path) -> Story:
    """Read a log. A last line without its end, as a kill leaves it, is passed over. A RecordError says that
    the file is absent, or names a line that is none of a log's."""
    if not path.exists():
        raise RecordError(f"{path} does not exist; runs of this version of abcd_ns write it.")
    texts = path.read_bytes().split(b"\n")[:-1]
    story = Story(tuple(_read_line(text, f"{path}, line {row}") for row, text in enumerate(texts, 1)), 0)
    training = story.last(TrainingLine)
    if training is None:
        raise RecordError(f"{path} does not say when training began; it is not the log of a run.")
    lines = (*story.since_cut.of(VisitLine), *story.since_cut.visits)
    visited = [line.block + 1 for line in lines if line.block is not None]
    cut = story.last(CutAnewLine)
    return replace(story, blocks=max([training.blocks if cut is None else cut.blocks, *visited]))


def _read_line(text: bytes, where: str) -> Line:
    try:
        data = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RecordError(f"{where} is damaged ({error}); remove it to see the rest.") from None
    kind = data.pop("kind", None) if isinstance(data, dict) else None
    if kind not in list(KINDS):
        raise RecordError(f"{where} is of the unknown kind {kind!r}; another version of abcd_ns wrote it.")
    line = decode(KINDS[kind], data, where)
    if isinstance(line, TrainingLine) and line.schema != SCHEMA:
        raise RecordError(f"{where} has schema {line.schema}; this version of abcd reads schema {SCHEMA}.")
    return line
