"""How a run ends: whole, at Ctrl-C and SIGTERM between two steps; and what it says of going on."""

import shlex
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from abcd_ns.nerfstudio.flags import value_of

SIGNALS = (signal.SIGINT, signal.SIGTERM)
FORGOTTEN = ("--load-dir", "--load-step", "--load-checkpoint")
"""Options of a run that the command to resume it does not repeat."""


class Stopped(BaseException):
    """The user, or the machine's scheduler, asked the run to end."""

    def __init__(self, received: signal.Signals) -> None:
        super().__init__(received)
        self.received = received


@contextmanager
def at_once(say: Callable[[], None]) -> Iterator[None]:
    """Let Ctrl-C call `say` and end the process as shells expect; nerfstudio's own way exits with 0."""
    try:
        yield
    except KeyboardInterrupt:
        say()
        raise SystemExit(128 + signal.SIGINT) from None


class StopSignals:
    """While entered, turns the first signal into Stopped: at once, or at the end of what must not be cut.

    A second signal acts as usual, so that nobody has to wait. Only the main thread gets signals.
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
        """Let signals wait for `check` or `release`."""
        self._held = True

    def release(self) -> None:
        """Let signals act at once again; raise Stopped if one came meanwhile."""
        self._held = False
        self.check()

    def check(self) -> None:
        """Raise Stopped if a signal waits."""
        if self._received is not None:
            raise Stopped(self._received)

    def _receive(self, number: int, _: FrameType | None) -> None:
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
    argv: Sequence[str], method: str, folder: Path, changed: Sequence[str] = ()
) -> str | None:
    """The same command with --load-dir `folder`, and an option and its value `changed`; None if it is not
    `ns-train`'s, or takes no options beside a file's."""
    program, *words = argv
    by_file = value_of(words, "--load-config") is not None
    if by_file or Path(program).name != "ns-train" or words[:1] != [method]:
        return None
    kept, skip = list[str](), False
    for word in words[1:]:
        name = word.partition("=")[0].replace("_", "-")
        if skip or name in (*FORGOTTEN, *changed[:1]):
            skip = not skip and "=" not in word
        else:
            kept.append(word)
    return shlex.join(["ns-train", method, "--load-dir", str(folder), *changed, *kept])


def next_steps(run: Path, data: Path, longer: str | None) -> str:
    """Commands for the finished run in a folder, each below a line that says what it does; `longer` trains
    twice as long."""
    steps = {
        "A page about the run:": shlex.join(["abcd", "report", str(run), "--data", str(data)]),
        "Look around in the scene:": shlex.join(["ns-viewer", "--load-config", str(run / "config.yml")]),
        "A file for other viewers:": shlex.join(["abcd", "export", str(run), "--out", "scene.ply"]),
    }
    steps |= {"Train twice as long:": longer} if longer else {}
    return "\n".join(["Next:", *(f"  {what}\n    {command}" for what, command in steps.items())])
