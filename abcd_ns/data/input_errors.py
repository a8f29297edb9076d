"""Errors in what the user gave: one line per file, naming the file and what to do about it."""

from collections.abc import Iterator
from contextlib import contextmanager

from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from abcd_ns.errors import UserError
from abcd_ns.terminal import print_plain

SHOWN = 20  # lines of one error that are shown; the others are counted
FEW = 3  # files with the same fault that are named; of more, others than the first are counted


def one_line(text: str) -> str:
    """`text` fit for a terminal: control characters and undecodable bytes of file names are escaped."""
    escaped = (c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text)
    return "".join(escaped)


def say(text: str, style: str | None = None) -> None:
    """Print text as it is, where nerfstudio prints."""
    print_plain(text, CONSOLE, style)


def print_error(text: str) -> None:
    """Say on the console what the user can mend."""
    CONSOLE.print(f"[bold red]error:[/] {escape(text)}", soft_wrap=True, highlight=False)


@contextmanager
def exit_on_user_error() -> Iterator[None]:
    """End the process with code 2 and the message alone, no traceback, where the body raises UserError."""
    try:
        yield
    except UserError as error:
        print_error(str(error))
        raise SystemExit(2) from None


class InputError(UserError):
    """The input cannot be used; a command shows `str(error)` alone and exits with code 2. Each line is a
    sentence that names the file or value and the fix; of more than SHOWN, `str(error)` counts the rest."""

    def __init__(self, *lines: str):
        self.lines = tuple(one_line(line) for line in lines)
        rest = len(lines) - SHOWN
        more = [f"... and {rest} more like these ({len(lines)} in all)."] if rest > 0 else []
        super().__init__("\n".join([*self.lines[:SHOWN], *more]))


class Problems(list[str]):
    """Collects errors, so that all bad files are named at once."""

    def __init__(self) -> None:
        super().__init__()
        self._alike: dict[str, list[str]] = {}

    @contextmanager
    def collect(self, label: str = "", name: str = "") -> Iterator[None]:
        """Note the body's InputError, if any. Many lines that are equal but for `name` become one."""
        try:
            yield
        except InputError as error:
            for line in error.lines:
                self.append(label + line)
                if name:
                    self._alike.setdefault(self[-1].replace(one_line(name), ""), []).append(self[-1])

    def raise_if_any(self) -> None:
        """Raise one InputError with all that was noted, if anything was."""
        lines = list(dict.fromkeys(self))
        for first, *others in self._alike.values():
            if len(others) >= FEW:
                lines[lines.index(first)] += f" {len(others)} others have the same fault."
                alike = set(others)
                lines = [line for line in lines if line not in alike]
        if lines:
            raise InputError(*lines)
