"""Ctrl-C and SIGTERM: a run ends between two steps, when it is whole, and says how to resume it."""

import shlex
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
FORGOTTEN = ("--load-dir", "--load-step", "--load-checkpoint")
"""Options that say where a run began: what goes on from it has its own."""


class Stopped(BaseException):
    """The user, or the machine's scheduler, asked the run to end."""

    def __init__(self, received: signal.Signals) -> None:
        super().__init__(received)
        self.received = received

    @property
    def exit_code(self) -> int:
        """What a shell expects of a process that was ended by a signal."""
        return 128 + self.received


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
