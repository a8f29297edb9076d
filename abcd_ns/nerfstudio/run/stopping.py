"""How a run ends: whole, at Ctrl-C and SIGTERM between two steps; and what it says of going on."""

import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from abcd_ns.engine.train.trainer import Trainer

SIGNALS = (signal.SIGINT, signal.SIGTERM)
FORGOTTEN = ("--load-dir", "--load-step", "--load-checkpoint")
"""Options that say where a run began: what goes on from it has its own."""


class Stopped(BaseException):
    """The user, or the machine's scheduler, asked the run to end."""

    def __init__(self, received: signal.Signals) -> None:
        super().__init__(received)
        self.received = received


@contextmanager
def at_once(say: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C where nothing waits for the end of a step ends the process as shells expect, with what `say`
    says: nerfstudio shows a traceback, and exits with 0."""
    try:
        yield
    except KeyboardInterrupt:
        say()
        raise SystemExit(128 + signal.SIGINT) from None


class StopSignals:
    """While entered, turns the first signal into Stopped: at once, or at the end of what must not be cut.

    A second signal acts as it always did, so that nobody has to wait. In other threads
    than the main one nothing happens: Python gives signals to that alone.
    """

    def __init__(self) -> None:
        self._received: signal.Signals | None = None
        self._held = False
        self._before: dict[signal.Signals, object] = {}

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._receive) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def hold(self) -> None:
        """From now on a signal waits for `check` or `release`."""
        self._held = True

    def release(self) -> None:
        """Signals act at once again.

        Raises:
            Stopped: one came meanwhile.
        """
        self._held = False
        self.check()

    def check(self) -> None:
        """Let a signal that waits have its way.

        Raises:
            Stopped: one came.
        """
        if self._received is not None:
            raise Stopped(self._received)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        del frame
        self._restore()
        self._received = signal.Signals(number)
        if not self._held:
            raise Stopped(self._received)

    def _restore(self) -> None:
        for number, handler in self._before.items():
            # None: a library set it, not Python, and it cannot be put back.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        self._before = {}


def command_to_resume(
    argv: Sequence[str], method: str, folder: Path, changed: Mapping[str, object] | None = None
) -> str | None:
    """What to type to resume the run in `folder`: the same command with --load-dir.

    Args:
        argv: the command line of this process; None is returned if it is not `ns-train`'s.
        changed: options that are given anew, by flag.
    """
    changed = changed or {}
    program, *words = argv
    if Path(program).name != "ns-train" or words[:1] != [method]:
        return None
    kept, skip = [], False
    for word in words[1:]:
        name = word.partition("=")[0].replace("_", "-")
        if skip or name in FORGOTTEN or name in changed:
            skip = not skip and "=" not in word
        else:
            kept.append(word)
    options = [str(word) for option in changed.items() for word in option]
    return shlex.join(["ns-train", method, "--load-dir", str(folder), *options, *kept])


def next_steps(trainer: Trainer, method: str, data: Path, checkpoints: Path) -> list[str]:
    """Commands that follow on a run, each below a line that says what it does.

    Args:
        data: as given to `ns-train`.
        checkpoints: the folder of the run's checkpoints, in the run's own.
    """
    run, state = checkpoints.parent, trainer.state
    blocks = trainer.scene.tree.num_blocks
    seen = [block for block in range(blocks) if state.views.get(block) != 0]
    missed = sum(block not in state.health or state.health[block].visits == 0 for block in seen)
    report = ["abcd", "report", str(run), "--data", str(data)]
    steps = {
        "A page about the run:": shlex.join(report),
        "Look around in the scene:": shlex.join(["ns-viewer", "--load-config", str(run / "config.yml")]),
        "A file for other viewers:": shlex.join(["abcd", "export", str(run), "--out", "scene.ply"]),
    }
    longer = command_to_resume(sys.argv, method, checkpoints, _doubled(trainer))
    if longer is not None:
        why = f", as {missed} of {blocks} blocks were not visited" if missed and state.visit else ""
        steps[f"Train twice as long{why}:"] = longer
    return [line for what, command in steps.items() for line in (f"  {what}", f"    {command}")]


def _doubled(trainer: Trainer) -> dict[str, object]:
    """The option that ended the run, with twice its value."""
    budget, seconds = trainer.run.budget, trainer.stopwatch.seconds
    if budget.seconds is None or trainer.state.step / budget.steps >= seconds / budget.seconds:
        return {"--max-num-iterations": 2 * budget.steps}
    return {"--pipeline.max-seconds": f"{2 * budget.seconds:g}"}
