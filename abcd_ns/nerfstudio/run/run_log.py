"""A run's log: what happened when, a JSON object a line, in `abcd/log.jsonl`; `abcd report` reads it."""

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from statistics import fmean
from typing import Any

import psutil
import torch

from abcd_ns.data.input_errors import say
from abcd_ns.data.photos import Photos
from abcd_ns.engine import events
from abcd_ns.engine.render.cuda import fused
from abcd_ns.engine.store.atomic import write_file
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.machine import peak_device_bytes, peak_rss_bytes
from abcd_ns.nerfstudio.run.log_lines import (
    KIND_OF,
    KINDS,
    SCHEMA,
    CutAnewLine,
    Line,
    SampleLine,
    VisitEndLine,
)

LOG_FILE = "log.jsonl"
SECONDS_BETWEEN_SAMPLES = 1.0
SAMPLES = 300  # gaps grow to 1 / SAMPLES of the time so far: a day's log is hardly longer than an hour's
LINES_KEPT = 64  # lines that wait in memory for the end of a visit, at most


class RunLog:
    """Listens to a coordinator and writes its events down. If the disk refuses, it says so once and ends.
    `earlier` is the log of the run that is resumed; it may be the same."""

    def __init__(self, coordinator: Trainer, photos: Photos, path: Path, earlier: Path | None = None) -> None:
        self._coordinator, self._photos = coordinator, photos
        self._path: Path | None = path
        self.visits: list[VisitEndLine] = []  # those that ended, of the whole run
        self.renumbered = 0  # of these, so many came before blocks got the numbers that they have
        self.curve: list[tuple[float, float]] = []
        """Seconds of training, and the mean PSNR of training crops since the point before, dB."""
        self._psnrs: list[float] = []
        self._visit_psnrs: dict[int, list[float]] = {}
        self._lines: list[str] = []
        self._workers: tuple[events.WorkerSeen, ...] = ()
        if earlier is not None:
            past = past_of(coordinator, earlier)
            with suppress(TypeError, KeyError):  # of another version
                for line in map(json.loads, past):
                    self._remember(KINDS[line.pop("kind")](**line))
            self._write(past, anew=True)
        self._sampled = coordinator.stopwatch.seconds
        scene, limit = coordinator.scene, coordinator.config.density.limit
        self._note(
            "training",
            schema=SCHEMA,
            blocks=scene.tree.num_blocks,
            gaussians=coordinator.count(),
            limit=limit,
            budgets=_kept(photos.budget_bytes, scene.ram_bytes, coordinator.layer_limit),
            compiled_loss=fused.photometric.runs,
        )
        self._flush()

    def __call__(self, event: events.Event) -> None:
        match event:
            case events.StepTaken():
                self._take_step(event)
            case events.VisitEnded():
                self._end_visit(event)
            case events.WorkersSeen():
                self._workers = event.workers
            case events.HeldOutScored():
                self._note("held out", psnr=_finite(event.psnr), ssim=_finite(event.ssim))
                self._flush()
            case _ if type(event) in KIND_OF:
                self._note(KIND_OF[type(event)], **vars(event))
                self._flush()

    def close(self) -> None:
        """Write what the training took."""
        self._sample()
        for worker in self._workers:
            told = {name: getattr(worker, name) for name in ("worker", "visits", "deaths")}
            self._note("worker", **told, waited=round(worker.waited, 3))
        peaks = {"peak_rss_bytes": peak_rss_bytes(), "peak_device_bytes": peak_device_bytes()[0]}
        self._note("end", gaussians=self._coordinator.count(), **peaks)
        self._flush()

    def _take_step(self, event: events.StepTaken) -> None:
        if math.isfinite(event.psnr):
            self._psnrs.append(event.psnr)
            self._visit_psnrs.setdefault(event.visit, []).append(event.psnr)
        seconds = self._coordinator.stopwatch.seconds
        if seconds - self._sampled >= max(SECONDS_BETWEEN_SAMPLES, seconds / SAMPLES):
            self._sample()

    def _end_visit(self, event: events.VisitEnded) -> None:
        self._sample()
        psnrs = self._visit_psnrs.pop(event.visit, [])
        seconds = {name: round(getattr(event, name), 3) for name in ("layer_seconds", "visit_seconds")}
        self._note("visit end", **vars(event) | seconds, psnr=_mean(psnrs[len(psnrs) // 2 :]))
        self._flush()

    def _sample(self) -> None:
        coordinator = self._coordinator
        self._note(
            "sample",
            psnr=_mean(self._psnrs),
            gaussians=coordinator.count(),
            rss_bytes=psutil.Process().memory_info().rss,
            device_bytes=torch.cuda.memory_allocated() if torch.cuda.is_available() else None,
            held=_kept(self._photos.cached_bytes, coordinator.scene.cached_bytes, coordinator.layer_bytes),
        )
        self._psnrs, self._sampled = [], coordinator.stopwatch.seconds

    def _note(self, kind: str, **fields: Any) -> None:
        now = {"step": self._coordinator.state.step, "seconds": round(self._coordinator.stopwatch.seconds, 3)}
        line = KINDS[kind](**now | fields)
        self._lines.append(json.dumps({"kind": kind, **asdict(line)}))
        if len(self._lines) >= LINES_KEPT:
            self._flush()
        self._remember(line)

    def _remember(self, line: Line) -> None:
        if isinstance(line, VisitEndLine):
            self.visits.append(line)
        elif isinstance(line, CutAnewLine):
            self.renumbered = len(self.visits)
        elif isinstance(line, SampleLine) and line.psnr is not None:
            self.curve.append((line.seconds, line.psnr))

    def _flush(self) -> None:
        lines, self._lines = self._lines, []
        self._write(lines)

    def _write(self, lines: Sequence[str], anew: bool = False) -> None:
        if self._path is None:
            return
        text = "".join(f"{line}\n" for line in lines)
        try:
            if anew:  # it may be the very log that the past was read from
                write_file(self._path, text.encode())
                return
            with open(self._path, "a", encoding="utf-8") as file:
                file.write(text)
        except OSError as error:
            say(f"{self._path} cannot be written ({error.strerror}); the run's log ends here.", "yellow")
            self._path = None


def past_of(coordinator: Trainer, log: Path) -> list[str]:
    """The lines of a log up to where a run was resumed from it, or up to a line that cannot be read."""
    state, kept = coordinator.state, []
    with suppress(OSError, ValueError, KeyError, TypeError):
        for text in log.read_bytes().decode("utf-8", "replace").splitlines():
            line = json.loads(text)
            # A visit that began after the checkpoint begins once more, at the same step.
            again = line["kind"] == "visit" and line["visit"] >= state.visit
            if line["step"] <= state.step and line["kind"] not in ("end", "worker") and not again:
                # The clock goes on from the commit; the line may have come after it.
                line["seconds"] = min(line["seconds"], round(coordinator.stopwatch.seconds, 3))
                kept.append(json.dumps(line))
    return kept


def _kept(photos: int, blocks: int, layers: int) -> dict[str, int]:
    """Bytes of what is kept in memory, by name."""
    return {"photos": photos, "frozen blocks": blocks, "layers": layers}


def _finite(value: float | None) -> float | None:
    """None in place of what JSON cannot hold."""
    return value if value is not None and math.isfinite(value) else None


def _mean(values: Sequence[float]) -> float | None:
    return round(fmean(values), 3) if values else None
