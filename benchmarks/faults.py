"""Injects faults into runs, and counts what is lost.

    python -m benchmarks.faults

Every run is a process of its own and small: 30 steps by the engine, 36 by nerfstudio's trainer. "Survived"
means: gone on with, it ended with the very bits of a run that nothing disturbed. Where a file was altered it
means that this was noticed. "Lost" counts steps that the run had said were safe.
"""

import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from rich.console import Console
from rich.progress import track

from abcd_ns.engine.store import ParameterStore, StoreError, crash_points
from abcd_ns.lab.results.tables import markdown
from benchmarks.runs import print_machine
from tests.nerfstudio.crash_training import Trainings, gaussians, run_folder
from tests.reference.colmap_scene import write_scene
from tests.reference.crash_runs import DISK_FULL, Kill, Runs, digest, lost_steps, points_reached

KILLED = -signal.SIGKILL
TRAINING_STEPS = 36
IMPORTED = ("tests.nerfstudio.crash_training", "tyro", "rich.progress")
"""What processes import of this module's own imports, once for all of them."""


@dataclass
class Args:
    """How much to do."""

    kills: int = 30
    """Kills of the engine at random times."""
    flips: int = 300
    """Bits flipped in each kind of file."""
    engine: bool = True
    """Whether runs of the engine, and files, are tried."""
    trainings: bool = True
    """Whether nerfstudio's trainer and the command `ns-train` are run, too."""
    seed: int = 0
    """Decides times, steps and bits."""


@dataclass
class Row:
    """What came of one kind of fault."""

    fault: str
    tried: int = 0
    survived: int = 0
    lost: int | None = None
    """Steps; None where that was not looked at."""
    seconds: list[float] = field(default_factory=list)
    """Until the process was gone, where that was measured."""


class Outcome(NamedTuple):
    """What came of one fault."""

    survived: bool
    lost: int | None = None
    seconds: float | None = None


class Trial(NamedTuple):
    """One fault to be injected."""

    fault: str
    inject: Callable[[], Outcome]


class Bench:
    """Makes the trials of all kinds; `folder` is scratch space."""

    def __init__(self, args: Args, folder: Path) -> None:
        self.args, self.folder = args, folder
        self.random = random.Random(args.seed)
        self.runs = Runs(*IMPORTED)
        self._train = folder / "undisturbed"
        if self.runs.finish(self._train) != 0:
            raise RuntimeError("the run that nothing disturbs failed")
        began = time.monotonic()  # of a second one: the first waits for the server
        self.runs.finish(self.new_folder())
        self.seconds = time.monotonic() - began
        self.expected = digest(self._train)

    def new_folder(self) -> Path:
        """An empty one for a trial."""
        return Path(tempfile.mkdtemp(dir=self.folder))

    def gone_on(self, folder: Path, lost: int) -> Outcome:
        """Finish the run in `folder`, compare, and clear it away."""
        survived = self.runs.finish(folder) == 0 and digest(folder) == self.expected
        shutil.rmtree(folder)
        return Outcome(survived, lost)

    # -- the engine --------------------------------------------------------------------------------

    def kills_at_random(self) -> Iterator[Trial]:
        """kill -9, once, or several times in a row."""
        for _ in range(self.args.kills):
            yield Trial(
                "kill -9 at a random time", partial(self._kill, [self.random.uniform(0, self.seconds)])
            )
        for _ in range(5):
            times = [self.random.uniform(0, self.seconds / 2) for _ in range(4)]
            yield Trial("kill -9 four times in a row", partial(self._kill, times))

    def _kill(self, times: list[float]) -> Outcome:
        folder, lost = self.new_folder(), 0
        for seconds in times:
            # A run that is done too soon is run again: the fault must happen.
            while not self.runs.killed_after(seconds, folder):
                seconds *= 0.8
                shutil.rmtree(folder)
            lost += lost_steps(folder)
        return self.gone_on(folder, lost)

    def kills_at_points(self) -> Iterator[Trial]:
        """kill -9 at each named point: the first time, in the middle, the last."""
        folder = self.new_folder()
        begun, resumed = points_reached(folder), points_reached(folder)
        for point in crash_points.ENGINE:
            times = begun.get(point, 0) or resumed[point]
            for nth in sorted({1, (times + 1) // 2, times}):
                yield Trial(
                    "kill -9 at a named point", partial(self._kill_at, Kill(point, nth), point not in begun)
                )

    def _kill_at(self, kill: Kill, when_resumed: bool) -> Outcome:
        folder = self.new_folder()
        if when_resumed:
            self.runs.finish(folder, kill=Kill(crash_points.VISIT_TRAINED, 3))
        if self.runs.finish(folder, kill=kill) != KILLED:
            return Outcome(False)
        return self.gone_on(folder, lost_steps(folder))

    def full_disks(self) -> Iterator[Trial]:
        """RLIMIT_FSIZE below what some file needs, and the n-th file that fails."""
        sizes = sorted(path.stat().st_size for path in (self._train / "store").iterdir())
        for limit in [0, *(size - 1 for size in sizes if size)]:
            yield Trial("no file may grow beyond a size", partial(self._refuse, {"file_bytes": limit}))
        for nth in [1, 2, 3, *(self.random.randrange(4, 40) for _ in range(9))]:
            yield Trial("the n-th file cannot be written", partial(self._refuse, {"failing_file": nth}))

    def _refuse(self, options: dict[str, int]) -> Outcome:
        folder = self.new_folder()
        code = self.runs.finish(folder, **options)
        said = folder / "error.txt"
        if code != DISK_FULL or len(said.read_text().splitlines()) != 1:
            return Outcome(False)
        return self.gone_on(folder, lost_steps(folder))

    # -- files -------------------------------------------------------------------------------------

    def altered_files(self) -> Iterator[Trial]:
        """Every file of a store cut short, and bits flipped in them."""
        store = self._train / "store"
        for path in sorted(store.iterdir()):
            size = path.stat().st_size
            if path.name == "lock":
                continue
            for length in sorted({0, 1, 7, size // 2, size - 1}):
                yield Trial("a store's file cut short", partial(self._alter, path.name, length, None))
            for _ in range(self.args.flips // 3):
                bit = self.random.randrange(8 * size)
                yield Trial("a bit flipped in a store's file", partial(self._alter, path.name, None, bit))

    def _alter(self, name: str, length: int | None, bit: int | None) -> Outcome:
        folder = self.new_folder() / "store"
        shutil.copytree(self._train / "store", folder)
        content = bytearray((folder / name).read_bytes())
        if bit is not None:
            content[bit // 8] ^= 1 << bit % 8
        (folder / name).write_bytes(content[:length])
        noticed = False
        try:
            for pin in (None, "saved"):  # every file belongs to one of both
                with ParameterStore.open(folder, pin, read_only=True) as store:
                    for block in store.blocks:
                        store.load(block)
        except StoreError as error:
            noticed = name in str(error)
        shutil.rmtree(folder.parent)
        return Outcome(noticed)

    def trials(self) -> list[Trial]:
        """All of the engine's."""
        kinds = (self.kills_at_random, self.kills_at_points, self.full_disks, self.altered_files)
        return [trial for kind in kinds for trial in kind()]


class TrainingBench:
    """The same through nerfstudio's trainer, and the command."""

    def __init__(self, args: Args, folder: Path) -> None:
        self.folder, self.random = folder, random.Random(args.seed)
        self.data = write_scene(folder / "wall")
        self.trainings = Trainings(*IMPORTED)
        if self.trainings.finish(self.data, folder / "undisturbed") != 0:
            raise RuntimeError("the training that nothing disturbs failed")
        self.expected = gaussians(run_folder(folder / "undisturbed"))
        self._command(self.folder / "command").wait()
        self.expected_of_command = gaussians(run_folder(self.folder / "command"))

    def trials(self) -> list[Trial]:
        """All of them."""
        steps = [self.random.randrange(1, TRAINING_STEPS) for _ in range(8)]
        found = [
            Trial("nerfstudio: kill -9 at a random step", partial(self._kill, {"kill_at_step": s}))
            for s in steps
        ]
        for point in crash_points.TRAINER:
            for nth in (1, 2, 4):
                kill = {"kill": Kill(point, nth)}
                found.append(Trial("nerfstudio: kill -9 while it saves", partial(self._kill, kill)))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            name = "Ctrl-C" if number == signal.SIGINT else number.name
            found += [Trial(f"ns-train: {name}", partial(self._signal, number)) for _ in range(2)]
        return found

    def _kill(self, how: dict) -> Outcome:
        out = Path(tempfile.mkdtemp(dir=self.folder))
        if self.trainings.finish(self.data, out, **how) != KILLED:
            return Outcome(False)
        run = run_folder(out)
        ended = self.trainings.finish(self.data, out, load_dir=run / "nerfstudio_models")
        return Outcome(ended == 0 and same(gaussians(run), self.expected))

    def _signal(self, number: signal.Signals) -> Outcome:
        out = Path(tempfile.mkdtemp(dir=self.folder))
        process = self._command(out)
        while process.poll() is None and not list(out.rglob("step-*.ckpt")):
            time.sleep(0.01)
        time.sleep(self.random.uniform(0, 0.3))
        process.send_signal(number)
        began = time.monotonic()
        code = process.wait()
        seconds = time.monotonic() - began
        expected = KILLED if number == signal.SIGKILL else 128 + number
        run = run_folder(out)
        self._command(out, "--load-dir", str(run)).wait()
        return Outcome(
            code == expected and same(gaussians(run), self.expected_of_command),
            seconds=None if number == signal.SIGKILL else seconds,
        )

    def _command(self, out: Path, *more: str) -> subprocess.Popen:
        options = {
            "--data": self.data,
            "--output-dir": out,
            "--timestamp": "run",
            "--max-num-iterations": 400,
            "--steps-per-save": 50,
            "--pipeline.blocks": 3,
            "--vis": "tensorboard",
        }
        words = [str(word) for option in options.items() for word in option]
        return subprocess.Popen(
            [str(Path(sys.executable).parent / "ns-train"), "abcd", *words, *more],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )


def same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> bool:
    """Whether two scenes are equal bit for bit."""
    return found.keys() == expected.keys() and all(
        torch.equal(found[name], value) for name, value in expected.items()
    )


def carry_out(trials: list[Trial], console: Console) -> list[Row]:
    """Inject one after the other."""
    rows: dict[str, Row] = {}
    for trial in track(trials, "Faults", console=console):
        outcome = trial.inject()
        if not outcome.survived:
            console.print(f"not survived: {trial.fault}, {trial.inject}", markup=False)
        row = rows.setdefault(trial.fault, Row(trial.fault))
        row.tried += 1
        row.survived += outcome.survived
        if outcome.lost is not None:
            row.lost = (row.lost or 0) + outcome.lost
        row.seconds += [] if outcome.seconds is None else [outcome.seconds]
    return list(rows.values())


def table(rows: list[Row]) -> str:
    """In Markdown."""
    lines = [["fault", "tried", "survived", "steps lost"]]
    for row in rows:
        slowest = f" (gone within {max(row.seconds):.1f} s)" if row.seconds else ""
        lost = "-" if row.lost is None else str(row.lost)
        lines.append([row.fault + slowest, str(row.tried), str(row.survived), lost])
    sums = (sum(row.tried for row in rows), sum(row.survived for row in rows))
    return markdown([*lines, ["all", *map(str, sums), str(sum(row.lost or 0 for row in rows))]])


def main(args: Args) -> int:
    """Inject all faults, print the table; 1 if anything was lost."""
    torch.set_num_threads(1)
    console = Console()
    with tempfile.TemporaryDirectory(prefix="abcd-faults-") as name:
        with console.status("runs that nothing disturbs"):
            trials = Bench(args, Path(name)).trials() if args.engine else []
            if args.trainings:
                trials += TrainingBench(args, Path(name) / "trainings").trials()
        rows = carry_out(trials, console)
    print_machine(f"seed {args.seed}\n")
    print(table(rows))
    return int(any(row.survived < row.tried or row.lost for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
