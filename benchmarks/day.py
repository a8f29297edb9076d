"""A day in the life of a run: little memory, many blocks, killed twice, gone on with, and scored.

    python -m benchmarks.day --data bonsai --out day

Everything is what a user would type: `ns-train`, `kill -9`, `ns-train --load-dir`, `ns-eval`. The memory of
each process is looked at five times a second.
"""

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import psutil
import tyro
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.results.style import in_style, save, write_beside
from abcd_ns.machine import describe_machine, describe_versions
from abcd_ns.units import GIB

BIN = Path(sys.executable).parent
SECONDS_BETWEEN_LOOKS = 0.2


@dataclass
class Args:
    """The day."""

    data: Path
    """A data set, at full size."""
    out: Path
    """Folder for the run, `day.json` and the chart; must not exist."""
    steps: int = 900
    """Of the whole run."""
    device_budget_gb: float = 0.611
    """`--pipeline.device-budget-gb`: decides the number of blocks."""
    ram_budget_gb: float = 0.5
    """`--pipeline.ram-budget-gb`: what may be kept at hand. Programs and a step's own work come on top."""
    max_gaussians: int = 120_000
    """`--pipeline.training.density.max-gaussians`."""
    ram_limit_gb: float = 2.0
    """What no process may ever exceed for the day to be a good one."""
    kills: int = 2
    seed: int = 0
    """Decides when the kills come."""


@dataclass
class Process:
    """One process of the day."""

    name: str
    began: float
    """Seconds since the day began."""
    ended: float = 0.0
    exit_code: int | None = None
    killed_at_step: int | None = None
    first_step: int | None = None
    """The step at which it went on."""
    rss: list[tuple[float, int]] = field(default_factory=list)
    """(seconds since the day began, bytes of RAM)."""

    @property
    def peak(self) -> int:
        """Bytes of RAM."""
        return max((used for _, used in self.rss), default=0)


class Day:
    """Starts the processes and watches them."""

    def __init__(self, args: Args, console: Console) -> None:
        self.args, self.console, self.began = args, console, time.monotonic()
        self.processes: list[Process] = []
        self.out = args.out / "outputs"

    @property
    def run(self) -> Path:
        """The run's folder."""
        return next(iter(self.out.glob("*/abcd/run")), self.out)

    def train(self, kill_at: int | None) -> Process:
        """Train, from where the run stands, until the end or until a step at which it is killed."""
        words = ["ns-train", "abcd", "--data", self.args.data, "--output-dir", self.out, "--timestamp", "run"]
        words += ["--max-num-iterations", self.args.steps, "--vis", "tensorboard", "--steps-per-save", 500]
        words += ["--pipeline.device-budget-gb", self.args.device_budget_gb]
        words += ["--pipeline.training.batch", 1]  # on so small a device
        words += ["--pipeline.ram-budget-gb", self.args.ram_budget_gb]
        words += ["--pipeline.training.density.max-gaussians", self.args.max_gaussians]
        if self.processes:
            words += ["--load-dir", self.run]
        process = self._watch(words, lambda: kill_at is not None and self.step() >= kill_at)
        if process.exit_code == -signal.SIGKILL:
            process.killed_at_step = self.step()
        begun = self.log("training")
        process.first_step = begun[-1]["step"] if begun else None
        return process

    def evaluate(self) -> dict[str, Any]:
        """nerfstudio's own scores of the finished run."""
        path = self.args.out / "eval.json"
        words = ["ns-eval", "--load-config", self.run / "config.yml", "--output-path", path]
        self._watch(words, lambda: False)
        return json.loads(path.read_text())["results"] if path.exists() else {}

    def log(self, kind: str | None = None) -> list[dict[str, Any]]:
        """The run's log so far, or those lines of it that are of a kind."""
        path = self.run / "abcd" / "log.jsonl"
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        # The last one may be half written.
        found = (json.loads(line) for line in lines if line.endswith("\n"))
        return [line for line in found if kind in (None, line["kind"])]

    def step(self) -> int:
        """The last one that the log tells of."""
        return max((line["step"] for line in self.log()), default=0)

    def _watch(self, words: list[Any], kill_now: Callable[[], bool]) -> Process:
        """Run a command; kill it when told to."""
        words = [str(word) for word in words]
        self.console.print(f"[{self._now():.0f} s] {' '.join(words)}", markup=False, highlight=False)
        record = Process(words[0], self._now())
        self.processes.append(record)
        with (self.args.out / f"{len(self.processes)}-{words[0]}.txt").open("w") as said:
            command = subprocess.Popen([str(BIN / words[0]), *words[1:]], stdout=said, stderr=said)
            looked = psutil.Process(command.pid)
            while command.poll() is None:
                try:
                    record.rss.append((round(self._now(), 1), looked.memory_info().rss))
                except psutil.Error:
                    break
                if kill_now():
                    command.kill()
                time.sleep(SECONDS_BETWEEN_LOOKS)
            record.exit_code = command.wait()
        record.ended = self._now()
        self.console.print(f"  exit code {record.exit_code}, at most {record.peak / GIB:.2f} GiB of RAM")
        return record

    def _now(self) -> float:
        return time.monotonic() - self.began


@in_style
def draw(processes: list[Process], limit: float, out: Path) -> None:
    """RAM over the day, with the kills; `limit` is in GiB."""
    figure, axes = plt.subplots(figsize=(7.0, 3.4), layout="constrained")
    for number, process in enumerate(processes):
        times = [seconds / 60 for seconds, _ in process.rss]
        axes.fill_between(times, [used / GIB for _, used in process.rss], color=f"C{number % 3}", alpha=0.75)
        if process.killed_at_step is not None:
            axes.axvline(process.ended / 60, color="black", linewidth=1)
            look = {"xycoords": ("data", "axes fraction"), "ha": "right", "va": "top", "fontsize": 9}
            text = f"kill -9\nstep {process.killed_at_step:,}"
            write_beside(axes, text, (process.ended / 60, 0.97), (-4, 0), **look)
    axes.axhline(limit, color="black", linestyle="--", linewidth=1)
    axes.set(xlabel="minutes", ylabel="RAM of the process (GiB)", ylim=(0, 1.25 * limit))
    save(figure, out, "day")


def main(args: Args) -> int:
    """Live the day; 1 if it was not a good one."""
    if args.out.exists():
        raise UserError(f"{args.out} exists already; choose a folder that does not.")
    args.data, args.out = args.data.resolve(), args.out.resolve()
    args.out.mkdir(parents=True)
    day, chance = Day(args, Console()), random.Random(args.seed)
    edges = [args.steps * (number + 0.25) / args.kills for number in range(args.kills)]
    for edge in edges:
        day.train(int(edge + chance.random() * 0.5 * args.steps / args.kills))
    last = day.train(None)
    scores = day.evaluate()
    ended = day.log("end")
    peak = max(process.peak for process in day.processes)
    found = {
        "args": vars(args) | {"data": args.data.name, "out": args.out.name},
        "machine": asdict(describe_machine()),
        "versions": asdict(describe_versions()),
        "date": date.today().isoformat(),
        "blocks": [line["blocks"] for line in day.log("training")],
        "gaussians": ended[-1]["gaussians"] if ended else None,
        "steps": day.step(),
        "scores": scores,
        "peak_rss_bytes": peak,
        "processes": [
            asdict(process) | {"rss": process.rss[::10], "peak": process.peak} for process in day.processes
        ],
    }
    (args.out / "day.json").write_text(json.dumps(found, indent=1) + "\n")
    draw(day.processes, args.ram_limit_gb, args.out)
    shutil.copy(day.run / "abcd" / "log.jsonl", args.out / "log.jsonl")
    good = last.exit_code == 0 and bool(scores) and peak <= args.ram_limit_gb * GIB
    psnr = scores.get("psnr", float("nan"))
    print(
        f"{found['steps']} steps, blocks {found['blocks']}, {found['gaussians']} Gaussians, {psnr:.2f} dB, "
        f"at most {peak / GIB:.2f} GiB: {'a good day' if good else 'not a good day'}"
    )
    return int(not good)


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except UserError as error:
        print(f"error: {error}")
        sys.exit(2)
