"""Runs of the engine, in processes that are killed, on a scene small enough to train in a second or two.

Processes are forked from a server that has everything imported, so each starts at once; they are processes
all the same, and are killed by SIGKILL. What a run must end with does not depend on whether it was killed.
"""

import hashlib
import json
import multiprocessing
import os
import resource
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import torch

from abcd_ns.engine.events import VisitEnded
from abcd_ns.engine.store import ParameterStore, StoreError, crash_points
from abcd_ns.engine.train.coordinator import Coordinator
from tests.reference.scenes import (
    GROWING,
    Photos,
    listen,
    make_coordinator,
    random_gaussians,
    ring_of_views,
    steps_of,
)

STEPS = 30
SAVE_EVERY = 4
"""Steps between saves in the middle of visits, as nerfstudio's checkpoints are."""
LAYER_BYTES = 10_000
"""Room for some views' layers; others are drawn anew."""
DISK_FULL = 3
"""Exit code of a run that the disk refused."""
WALL_TIMES = ("seconds", "layer_seconds", "began", "since", "until")
"""Parts of a run's state that clocks decide."""
_PROGRESS = "progress.txt"


@dataclass(frozen=True)
class Kill:
    """Where a run kills itself: the n-th time, counted from 1, that it reaches a point."""

    point: str
    nth: int = 1


def run(
    folder: Path, kill: Kill | None = None, file_bytes: int | None = None, commit_seconds: float = 0.0
) -> None:
    """Train from where `folder` stands to the end; the body of a process.

    Args:
        commit_seconds: as of TrainingConfig. With 0 the run says at the end of each visit that it is safe.
        file_bytes: no file may grow above this, as on a full disk.
    """
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    if kill is not None:
        crash_points.reached = killer(kill)
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    if file_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, most))
    try:
        _train(folder, commit_seconds)
    except (StoreError, OSError) as error:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
        (folder / "error.txt").write_text(str(error))
        os._exit(DISK_FULL)


def killer(kill: Kill) -> Callable[[str], None]:
    """For `crash_points.reached`: ends this process as `kill -9` does."""
    left = kill.nth

    def reached(point: str) -> None:
        nonlocal left
        left -= point == kill.point
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    return reached


def points_reached(folder: Path) -> set[str]:
    """What an undisturbed run in `folder` reaches. Runs in this process."""
    found: set[str] = set()
    with mock.patch.object(crash_points, "reached", found.add):
        _train(folder)
    return found


def _train(folder: Path, commit_seconds: float = 0.0) -> None:
    views = ring_of_views(3, width=24, height=18)
    photos = Photos(random_gaussians(60, seed=7, size=0.12), views)
    coordinator = _open(folder, views, commit_seconds)

    def note(*_: Any) -> None:
        (folder / _PROGRESS).write_text(str(coordinator.state.step))

    if commit_seconds == 0:
        listen(coordinator, VisitEnded, note)
    for step in steps_of(coordinator, photos):
        if step % SAVE_EVERY == 0:
            coordinator.save(pin="saved")
            note()
    coordinator.save()
    coordinator.close()


def _open(folder: Path, views: list, commit_seconds: float) -> Coordinator:
    """Go on from a clone of what is there, as the trainer does with --load-dir, or begin."""
    resume = begun(folder)
    if resume:
        shutil.rmtree(folder / "clone", ignore_errors=True)
        with ParameterStore.open(folder / "store") as store:
            store.clone_to(folder / "clone")
        ParameterStore.open(folder / "clone").close()
        shutil.rmtree(folder / "clone")
    else:
        shutil.rmtree(folder / "store", ignore_errors=True)
    options = {"blocks": 3, "steps": STEPS, "coarse_model": 20, "batch": 2, "density": GROWING}
    options |= {"layer_bytes": LAYER_BYTES, "commit_seconds": commit_seconds, "resume": resume}
    return make_coordinator(folder, random_gaussians(60, seed=1, size=0.12), views, **options)


def begun(folder: Path) -> bool:
    """Whether there is anything to go on from."""
    if not (folder / "store" / "manifest.json").exists():
        return False
    return bool(ParameterStore.open(folder / "store", read_only=True).blocks)


# -- from outside --------------------------------------------------------------------------------------


class Runs:
    """Starts runs in processes of their own and looks at what they leave."""

    body: Callable[..., None] = staticmethod(run)
    """What a process does."""

    def finish(self, *args: Any, within: float | None = None, **options: Any) -> int:
        """Run to the end, until the process is killed, or for so many seconds; its exit code."""
        # Forked: to import torch and nerfstudio in each would take seconds.
        process = multiprocessing.get_context("fork").Process(target=self.body, args=args, kwargs=options)
        process.start()
        process.join(within)
        process.kill()
        process.join()
        return process.exitcode


def lost_steps(folder: Path) -> int:
    """Steps that were safe, by what the run said, and are not in the store; 0 unless something is wrong."""
    progress = folder / _PROGRESS
    said = int(progress.read_text() or 0) if progress.exists() else 0
    if not begun(folder):
        return said
    kept = ParameterStore.open(folder / "store", read_only=True).state.get("step", 0)
    return max(said - kept, 0)


def digest(folder: Path) -> str:
    """Of all blocks' tensors and clocks, and the run's state but for wall times; every byte is checked."""
    found = hashlib.blake2b(digest_size=16)
    with ParameterStore.open(folder / "store", read_only=True) as store:
        for block in store.blocks:
            tensors, meta = store.load(block)
            found.update(json.dumps([block, meta], sort_keys=True).encode())
            for name in sorted(tensors):
                found.update(f"{name} {tuple(tensors[name].shape)}".encode())
                found.update(tensors[name].numpy().tobytes())
        state = {name: value for name, value in store.state.items() if name not in WALL_TIMES}
        found.update(json.dumps(state, sort_keys=True).encode())
    return found.hexdigest()
