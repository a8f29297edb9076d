"""Bytes by key under a limit, in memory or in LMDB; never raises for what a disk does. Not thread-safe."""

import mmap
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import lmdb

from abcd_ns.engine.storage import crash_points
from abcd_ns.engine.storage.atomic import FolderLock

T = TypeVar("T")

_FILES = ("data.mdb", "lock.mdb")
_LEAST_PAGES = 16  # LMDB needs a few beside the values


class MemoryEntries:
    """A dictionary that empties itself when its values would exceed the limit."""

    def __init__(self, limit: int):
        self.evictions = self.rejected = self.recreated = 0
        self._limit = limit
        self._values: dict[bytes, bytes] = {}
        self._nbytes = 0

    def get(self, key: bytes) -> bytes | None:
        return self._values.get(key)

    def put_many(self, items: Sequence[tuple[bytes, bytes]]) -> None:
        for key, value in items:
            self.delete(key)
            if len(value) > self._limit:
                self.rejected += 1
                continue
            if self._nbytes + len(value) > self._limit:
                self.clear()
                self.evictions += 1
            self._values[key] = value
            self._nbytes += len(value)

    def delete(self, key: bytes) -> None:
        self._nbytes -= len(self._values.pop(key, b""))

    def drop(self, start: bytes) -> None:
        """Delete all keys that begin with `start`."""
        for key in [key for key in self._values if key.startswith(start)]:
            self.delete(key)

    def clear(self) -> None:
        self._values.clear()
        self._nbytes = 0

    def close(self) -> None:
        self.clear()

    @property
    def nbytes(self) -> int:
        return self._nbytes

    def __len__(self) -> int:
        return len(self._values)


class LmdbEntries:
    """An LMDB environment that begins empty, and is made anew whenever it is full or the disk refuses it.

    LMDB trusts its files: one flipped bit of a page can crash the process that maps it. And pages are written
    without syncing. So what an earlier process left is thrown away unread.
    """

    def __init__(self, folder: Path, limit: int):
        self.evictions = self.rejected = self.recreated = 0
        self._folder = folder
        self._limit = max(limit // mmap.PAGESIZE, _LEAST_PAGES) * mmap.PAGESIZE
        self._environment: lmdb.Environment | None = None
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = FolderLock(folder)
        self._closed = False
        try:
            self._delete_files()
            self._environment = self._open()
            crash_points.reached(crash_points.CACHE_OPENED)
        except BaseException:
            self._lock.release()
            raise

    def get(self, key: bytes) -> bytes | None:
        def read(environment: lmdb.Environment) -> bytes | None:
            with environment.begin() as transaction:
                return transaction.get(key)

        return self._attempt(read)

    def put_many(self, items: Sequence[tuple[bytes, bytes]]) -> None:
        """Put all in one transaction; if they do not fit, empty the environment and put what does."""
        fitting = [item for item in items if len(item[1]) <= self._limit - _LEAST_PAGES * mmap.PAGESIZE // 2]
        self.rejected += len(items) - len(fitting)
        if not fitting or self._put(fitting):
            return
        for item in fitting:  # together they may exceed the limit where each does not
            if not self._put([item]) and not self._put([item]):
                self.rejected += 1

    def delete(self, key: bytes) -> None:
        def remove(environment: lmdb.Environment) -> None:
            with environment.begin(write=True) as transaction:
                transaction.delete(key)

        self._attempt(remove)

    def drop(self, start: bytes) -> None:
        """Delete all keys that begin with `start`, which is not empty."""

        def remove(environment: lmdb.Environment) -> None:
            with environment.begin(write=True) as transaction, transaction.cursor() as cursor:
                cursor.set_range(start)
                while cursor.key().startswith(start):
                    cursor.delete()  # and stand on the next

        self._attempt(remove)

    def clear(self) -> None:
        self._require_open()
        self._recreate()

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        if self._environment is not None:
            self._environment.close()
        self._environment = None
        self._lock.release()

    @property
    def nbytes(self) -> int:
        stat = self._attempt(lambda environment: environment.stat())
        if stat is None:
            return 0
        return stat["psize"] * (stat["branch_pages"] + stat["leaf_pages"] + stat["overflow_pages"])

    def __len__(self) -> int:
        stat = self._attempt(lambda environment: environment.stat())
        return stat["entries"] if stat else 0

    def _put(self, items: Sequence[tuple[bytes, bytes]]) -> bool:
        """Put all and say True, or lose everything and say False."""

        def write(environment: lmdb.Environment) -> bool:
            with environment.begin(write=True) as transaction:
                for key, value in items:
                    transaction.put(key, value)
                crash_points.reached(crash_points.LAYERS_PUT)
            return True

        return self._attempt(write) is True

    def _attempt(self, work: Callable[[lmdb.Environment], T]) -> T | None:
        """The result of `work`; or None, and an empty environment, if LMDB fails."""
        self._require_open()
        if self._environment is None:  # could not be made anew the last time
            self._recreate()
        if self._environment is None:
            return None
        try:
            return work(self._environment)
        except lmdb.MapFullError:
            self.evictions += 1
        except lmdb.Error:  # on a full disk too: what the cache gives back, the store can use
            self.recreated += 1
        self._recreate()
        return None

    def _require_open(self) -> None:
        if self._closed:
            raise RuntimeError(f"The layer cache in {self._folder} is closed.")

    def _recreate(self) -> None:
        if self._environment is not None:
            self._environment.close()
            self._environment = None
        with suppress(OSError):
            self._delete_files()
            self._environment = self._open()

    def _delete_files(self) -> None:
        for name in _FILES:
            (self._folder / name).unlink(missing_ok=True)

    def _open(self) -> lmdb.Environment:
        """An empty environment.

        Raises:
            OSError: none can be made.
        """
        try:
            return lmdb.open(
                str(self._folder),
                map_size=self._limit,
                sync=False,
                metasync=False,
                lock=False,  # the folder's lock and the cache's mutex leave nothing for LMDB's to do
            )
        except lmdb.Error as error:
            raise OSError(f"No layer cache can be made in {self._folder}: {error}.") from error


Entries = MemoryEntries | LmdbEntries
"""What a layer cache needs of its memory or disk: the methods that the two share."""
