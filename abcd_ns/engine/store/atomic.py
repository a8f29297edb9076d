"""Files that are either wholly old or wholly new, and folders that have one writer."""

import fcntl
import os
import secrets
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from abcd_ns.engine.store import crash_points
from abcd_ns.errors import UserError

LOCK_NAME = "lock"
TEMPORARY_SUFFIX = ".tmp"


def fsync_folder(folder: Path) -> None:
    """Make the names in `folder` (what was created, replaced, deleted) survive a power loss."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def replacing(path: Path, folder: Path | None = None) -> Iterator[Path]:
    """Give a temporary path to write to, in `folder` or beside `path`; on leaving, sync it and put it in
    place.

    If anything fails, `path` is what it was and the temporary file is gone. The new name survives a
    power loss only after `fsync_folder(path.parent)`, so that several files can share one such call.
    """
    temporary = (folder or path.parent) / f".{path.name}.{secrets.token_hex(4)}{TEMPORARY_SUFFIX}"
    try:
        yield temporary
        crash_points.reached(crash_points.FILE_WRITTEN)
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        crash_points.reached(crash_points.FILE_SYNCED)
        os.replace(temporary, path)
        crash_points.reached(crash_points.FILE_IN_PLACE)
    except BaseException:  # an interrupt must not leave the temporary file behind either
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise


def write_file(path: Path, data: bytes) -> None:
    """Replace the content of `path`; when this returns, it survives a power loss. If the disk refuses, by
    OSError, `path` holds either the old content or the new."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)
    fsync_folder(path.parent)


def remove_temporaries(folder: Path) -> None:
    """Delete what `replacing` left in `folder` when its process was killed. Only for the one writer."""
    for pattern in (f".*{TEMPORARY_SUFFIX}", ".tmp*"):  # the second are safetensors' own
        for leftover in folder.glob(pattern):
            with suppress(OSError):
                leftover.unlink()


class FolderLockedError(UserError):
    """Another writer has the folder open."""


class FolderLock:
    """The right to write in an existing folder: of one object of one process, and freed when that dies.
    FolderLockedError says that another one holds it, OSError that the folder is not writable."""

    def __init__(self, folder: Path):
        descriptor = os.open(folder / LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o644)
        self.release = weakref.finalize(self, os.close, descriptor)
        """Call it to let others write; harmless when done twice."""
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(descriptor, 32, 0).decode(errors="replace").strip() or "unknown"
            self.release()
            raise FolderLockedError(
                f"{folder} is being written by another run (process {holder}); "
                "wait for it, stop it, or choose another folder."
            ) from error
        with suppress(OSError):  # the number only serves the message above; a full disk may lack room for it
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        _held.add(self)


_held: "weakref.WeakSet[FolderLock]" = weakref.WeakSet()


def _forget_inherited_locks() -> None:
    """A forked worker shares its parent's lock, and would keep it held after the parent is killed."""
    for lock in list(_held):
        lock.release()


os.register_at_fork(after_in_child=_forget_inherited_locks)
