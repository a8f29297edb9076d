"""Made-up runs for tests of `abcd report`. No number here was ever measured."""

import copy
import dataclasses
import json
from datetime import datetime, timezone
from pathlib import Path

import torch

from abcd_ns.cli.report.held_out import HeldOut, Shown
from abcd_ns.cli.report.run_folder import Checkpoint, RunFolder
from abcd_ns.cli.report.story import read_story
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.lab.results.results import ViewScore
from abcd_ns.lab.runs.configs import REGISTERED
from abcd_ns.nerfstudio.options import mirror
from abcd_ns.nerfstudio.run import log_lines
from abcd_ns.nerfstudio.run.log_lines import KINDS
from abcd_ns.nerfstudio.run.run_log import LOG_FILE
from abcd_ns.nerfstudio.run.settings import SCHEMA, Settings, flat_options
from abcd_ns.run import SETTINGS_FILE, STATE
from tests.lab.compare.records import MACHINE, VERSIONS

TRAINING = {
    "schema": log_lines.SCHEMA,
    "blocks": 3,
    "gaussians": 300,
    "limit": 1000,
    "budgets": {"photos": 1 << 30, "layers": 4 << 30},
}
MADE_UP = {"psnr": 20.0, "held": {}, "block": 0, "compiled_loss": False}
PIXEL = "data:image/png;base64,AAAA"


def line(kind: str, step: int, seconds: float, **fields) -> str:
    """A line of a log; what is not given is made up."""
    made_up = {entry.name: MADE_UP.get(entry.name, 1) for entry in dataclasses.fields(KINDS[kind])}
    return json.dumps({"kind": kind, **made_up, "step": step, "seconds": seconds, **fields})


def log_lines() -> list[str]:
    """A run of three blocks: warm-up, one epoch, no end."""
    lines = [line("training", 0, 0.0, **TRAINING)]
    lines.append(line("visit", 0, 0.0, visit=0, block=None))
    lines.append(line("visit end", 10, 4.0, visit=0, block=None, layer_seconds=0.0, visit_seconds=4.0))
    for visit in (1, 2, 3):
        began, block = 10 * visit, visit - 1
        lines.append(line("visit", began, 4.0 * visit, visit=visit, block=block))
        memory = {"rss_bytes": 1 << 30, "device_bytes": None, "held": {"photos": 1 << 29}}
        lines.append(line("sample", began + 5, 4.0 * visit + 2, gaussians=300 + began, **memory))
        end = {"visit": visit, "block": block, "layer_seconds": 1.0, "visit_seconds": 4.0}
        lines.append(line("visit end", began + 10, 4.0 * visit + 4, psnr=20.0 + visit, **end))
    lines.append(line("held out", 40, 16.0, psnr=24.5, ssim=0.75))
    return [*lines, line("epoch end", 40, 16.0, epoch=0)]


def write_log(path: Path, lines: list[str]) -> Path:
    path.write_text("".join(f"{text}\n" for text in lines))
    return path


def made_up_settings(method: str = "abcd", **fields) -> Settings:
    """Settings at the method's defaults."""
    config = copy.deepcopy(REGISTERED.get(method, REGISTERED["abcd"]))
    mirror(config.pipeline.training, config.pipeline.model)
    values = {
        "schema": SCHEMA,
        "method": method,
        "scene": "made-up",
        "data": "made-up",
        "data_path": "/absent/made-up",
        "begun": datetime(2026, 1, 2, 3, 4, 5, tzinfo=timezone.utc),
        "options": flat_options(config),
        "versions": VERSIONS,
        "machine": MACHINE,
    }
    return Settings(**{**values, **fields})


def made_up_run(tmp_path: Path, **settings) -> RunFolder:
    """A run without a folder: three blocks over a cloud of points."""
    means = torch.randn(600, 3, generator=torch.Generator().manual_seed(0))
    tensors = {"_model.gauss_params.means": means}
    checkpoint = Checkpoint(tmp_path / "step.ckpt", 40, tensors, build_kd(means, 3))
    story = read_story(write_log(tmp_path / "log.jsonl", log_lines()))
    return RunFolder(tmp_path, made_up_settings(**settings), story, checkpoint)


def made_up_folder(path: Path) -> Path:
    """A run's folder with its settings and its log alone."""
    (path / STATE).mkdir(parents=True)
    settings = json.dumps(dataclasses.asdict(made_up_settings()), default=str)
    (path / STATE / SETTINGS_FILE).write_text(settings)
    write_log(path / STATE / LOG_FILE, log_lines())
    return path


def made_up_score(row: int, psnr: float, name: str | None = None) -> ViewScore:
    return ViewScore(row, name or f"{row:04d}.png", psnr - 0.5, 0.7, None, psnr, 0.8)


def made_up_held_out(name: str = "0000.png") -> HeldOut:
    """Two views, one of them shown."""
    first = made_up_score(0, 25.0, name)
    shown = Shown(first, "best", PIXEL, PIXEL, PIXEL, 64, 48)
    return HeldOut((first, made_up_score(8, 23.0)), "45.0 dB", (shown,), (0.002, 0.013))
