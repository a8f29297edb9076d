"""Blocks on disk: one immutable shard per block and generation, and one manifest that names those in use."""

import copy
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from torch import Tensor

from abcd_ns.engine.store import crash_points
from abcd_ns.engine.store.atomic import FolderLock, fsync_folder, remove_temporaries, write_file
from abcd_ns.engine.store.manifest import (
    Manifest,
    Shard,
    manifest_path,
    pin_names,
    read_checked_manifest,
    read_manifest,
)
from abcd_ns.engine.store.manifest import StoreError as StoreError
from abcd_ns.engine.store.shard import link_or_copy, read_shard, verify_shard, write_shard
from abcd_ns.engine.store.special_blocks import BlockName, in_order

Content = tuple[dict[str, Tensor], dict[str, Any]]  # of a block: tensors and JSON


class ParameterStore:
    """The blocks of a scene in a folder: tensors and JSON per block, committed all or nothing.

    A commit writes new shards beside the old ones and then replaces the manifest, so a kill at any instant
    leaves the previous generation or the new one. Every byte is checked against the manifest's checksums
    before it is used. One writer at a time, by a lock that dies with its process; readers need none.
    Threads may load while another one commits.

    Raises:
        StoreError: by all methods: what is read is missing or altered; the disk refuses, and what was there
            before is intact; or a store that is open for reading is to be changed.
        FolderLockedError: another writer has the folder that is to be written to.
    """

    def __init__(self, folder: Path, manifest: Manifest, lock: FolderLock | None):
        """Use `create` or `open` instead."""
        self.folder = folder
        self._manifest = manifest
        self._lock = lock
        self._verified: set[str] = set()

    @classmethod
    def create(cls, folder: Path | str, header: dict[str, Any]) -> "ParameterStore":
        """A new store without blocks, at generation 0, open for writing, in a folder that holds none yet."""
        folder = Path(folder)
        data, path = Manifest(0, header, {}, {}).to_bytes(), manifest_path(folder)
        lock = _claim(folder)
        try:
            write_file(path, data)
        except OSError as error:
            lock.release()
            raise StoreError(f"No store can be made in {folder}: {error.strerror}.") from error
        return cls(folder, Manifest.from_bytes(data, path), lock)

    @classmethod
    def open(
        cls, folder: Path | str, name: str | None = None, *, read_only: bool = False
    ) -> "ParameterStore":
        """The store in `folder`, for writing unless `read_only`; with `name`, what is pinned, for reading."""
        folder = Path(folder)
        if not folder.is_dir():
            raise StoreError(f"{folder} does not exist; give the folder of a store.")
        path = manifest_path(folder, name)
        if read_only or name is not None:
            return cls(folder, read_checked_manifest(path), None)
        read_manifest(path)  # before the lock, so that a folder that is no store stays untouched
        try:
            lock = FolderLock(folder)
        except OSError as error:
            raise StoreError(f"{folder} is not writable: {error.strerror}; open it read-only.") from error
        try:
            store = cls(folder, read_checked_manifest(path), lock)
            store._collect()
            return store
        except BaseException:
            lock.release()
            raise

    def close(self) -> None:
        """Let go of the lock; the store can still be read. Harmless when done twice."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def __enter__(self) -> "ParameterStore":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def generation(self) -> int:
        """Grows by one with every commit and restore."""
        return self._manifest.generation

    @property
    def header(self) -> dict[str, Any]:
        """A copy of the JSON given at creation, or last at a commit."""
        return copy.deepcopy(self._manifest.header)

    @property
    def state(self) -> dict[str, Any]:
        """A copy of the JSON last given as `state` to a commit; at first empty."""
        return copy.deepcopy(self._manifest.state)

    @property
    def blocks(self) -> list[BlockName]:
        """The blocks that have a shard, ascending, and then the names that have one."""
        return in_order(self._manifest.blocks)

    @property
    def pins(self) -> list[str]:
        return pin_names(self.folder)

    def counts(self, block: BlockName) -> int:
        """The rows of the block's tensor "means"; 0 if it has none."""
        return self._shard(block).rows

    def meta(self, block: BlockName) -> dict[str, Any]:
        """A copy of the block's JSON; no file is read."""
        return copy.deepcopy(self._shard(block).meta)

    def load(self, block: BlockName, names: Sequence[str] | None = None) -> Content:
        """The tensors of a block, on the CPU and owning their memory, and its JSON; KeyError for no block.
        Some `names` are checked once in the life of this object, all of them (None) each time."""
        while True:
            shard = self._shard(block)
            path = self.folder / shard.file
            try:
                if names is None or shard.file not in self._verified:
                    verify_shard(path, shard)
                    self._verified.add(shard.file)
                return read_shard(path, names), copy.deepcopy(shard.meta)
            except FileNotFoundError as error:
                if self._shard(block) == shard:
                    raise StoreError(
                        f"{path} is gone: deleted, or replaced by a newer generation than this reader's. "
                        "Open the store again, or read a pinned generation."
                    ) from error
                # A commit of another thread has replaced the shard just now: read the new one.
            except (OSError, SafetensorError) as error:
                raise StoreError(f"{path} cannot be read: {error}.") from error

    def commit(
        self,
        updates: Mapping[BlockName, Content] | Iterable[tuple[BlockName, Content]],
        header: dict[str, Any] | None = None,
        state: dict[str, Any] | None = None,
    ) -> int:
        """Make a new generation in which these blocks are replaced or added; return its number.

        All or nothing, and durable when it returns. Tensors may be of any device, dtype and strides; pairs
        are asked for one after another. None keeps the present header or state.

        Raises:
            StoreError: a write failed: the new files are gone, unless the disk refuses even to put the old
                manifest back; `generation` tells.
            TypeError, ValueError: something is not JSON.
        """
        self._require_writable()
        old = self._manifest
        generation = old.generation + 1
        with self._or_roll_back(f"Writing generation {generation} failed"):
            pairs = updates.items() if isinstance(updates, Mapping) else updates
            shards = {
                block: write_shard(self.folder, block, generation, tensors, meta)
                for block, (tensors, meta) in pairs
            }
            fsync_folder(self.folder)
            crash_points.reached(crash_points.SHARDS_IN_PLACE)
            header = old.header if header is None else header
            state = old.state if state is None else state
            self._publish(Manifest(generation, header, state, old.blocks | shards))
        self._verified.update(shard.file for shard in shards.values())
        self._collect()
        return generation

    def pin(self, name: str) -> None:
        """Keep the present generation under `name`, in place of what had this name, until `unpin`."""
        self._require_writable()
        path = manifest_path(self.folder, name)
        try:
            write_file(path, self._manifest.to_bytes())
        except OSError as error:
            raise StoreError(f"{path} could not be written: {error.strerror}.") from error
        self._collect()

    def unpin(self, name: str) -> None:
        self._require_writable()
        path = manifest_path(self.folder, name)
        try:
            path.unlink()
            fsync_folder(self.folder)
        except OSError as error:
            raise StoreError(f"Pin {name!r} could not be removed: {path}: {error.strerror}.") from error
        self._collect()

    def restore(self, name: str) -> int:
        """Make what is pinned under `name` a new generation; return its number, which grows. The pin stays,
        and blocks keep the versions they were pinned with."""
        self._require_writable()
        pinned = read_checked_manifest(manifest_path(self.folder, name))
        with self._or_roll_back(f"Pin {name!r} could not be restored"):
            self._publish(replace(pinned, generation=self.generation + 1))
        self._collect()
        return self.generation

    def clone_to(self, folder: Path | str, name: str | None = None) -> None:
        """Make `folder` a store that holds this generation, or the one pinned under `name`. Shards are shared
        by hard links where the file system can; as they are never changed, neither store alters the other."""
        folder = Path(folder)
        manifest = self._manifest
        if name is not None:
            manifest = read_checked_manifest(manifest_path(self.folder, name))
        lock = _claim(folder)
        try:
            for file in manifest.files:
                link_or_copy(self.folder / file, folder / file)
            fsync_folder(folder)
            crash_points.reached(crash_points.SHARDS_LINKED)
            write_file(manifest_path(folder), manifest.to_bytes())
        except BaseException as error:
            with suppress(OSError):
                for path in (manifest_path(folder), *(folder / file for file in manifest.files)):
                    path.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise StoreError(f"{self.folder} could not be cloned to {folder}: {error}.") from error
            raise
        finally:
            lock.release()

    def _shard(self, block: BlockName) -> Shard:
        try:
            return self._manifest.blocks[block]
        except KeyError:
            raise KeyError(f"{self.folder} has no block {block}; it has {self.blocks}.") from None

    def _require_writable(self) -> None:
        if self._lock is None:
            raise StoreError(f"{self.folder} is open for reading; open it without `read_only` and `name`.")

    def _publish(self, manifest: Manifest) -> None:
        """Make `manifest` the present one, on disk and here. Its shards must be on disk."""
        data, path = manifest.to_bytes(), manifest_path(self.folder)
        write_file(path, data)
        self._manifest = Manifest.from_bytes(data, path)  # shares nothing with what the caller holds
        crash_points.reached(crash_points.GENERATION_PUBLISHED)

    @contextmanager
    def _or_roll_back(self, failed: str) -> Iterator[None]:
        """Make a new generation in here, or keep the old one; `failed` says what the disk refused."""
        old = self._manifest
        try:
            yield
        except BaseException as error:
            outcome = self._roll_back(old)
            if isinstance(error, (OSError, SafetensorError)):
                raise StoreError(f"{failed}: {error}. {outcome}") from error
            raise

    def _roll_back(self, old: Manifest) -> str:
        """Undo a commit that failed anywhere, even after its manifest came into place; say what is left.
        Should the disk refuse that too, the manifest on disk decides; the shards of both are there."""
        path = manifest_path(self.folder)
        with suppress(OSError):
            if path.read_bytes() != old.to_bytes():
                write_file(path, old.to_bytes())
        try:
            self._manifest = read_manifest(path)
        except StoreError as error:
            return f"Nor can the manifest be read any more: {error}"
        self._collect()
        return f"{self.folder} holds generation {self.generation}, intact: free space or mend the disk."

    def _collect(self) -> None:
        """Delete the shards that no manifest names, and temporary files of writers that were killed."""
        remove_temporaries(self.folder)
        kept = self._manifest.files
        for name in self.pins:
            path = manifest_path(self.folder, name)
            try:
                kept |= read_manifest(path).files
            except StoreError as error:
                warnings.warn(f"Old shards are kept until pin {name!r} is removed: {error}", stacklevel=3)
                return
        for path in self.folder.glob("block-*.safetensors"):
            if path.name not in kept:
                with suppress(OSError):  # the commit stands; the next collection tries again
                    path.unlink()
                    crash_points.reached(crash_points.SHARD_DELETED)
        self._verified &= kept


def _claim(folder: Path) -> FolderLock:
    """Make `folder` if need be, and take its lock, for a new store in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FolderLock(folder)
    except OSError as error:
        raise StoreError(f"No store can be made in {folder}: {error.strerror}.") from error
    if manifest_path(folder).exists():
        lock.release()
        raise StoreError(f"{folder} already holds a store; open it, or choose another folder.")
    return lock
