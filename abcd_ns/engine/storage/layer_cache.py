"""Layers that were drawn before, on disk or in memory. Losing any of them costs time only."""

import hashlib
import json
import os
import re
import threading
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from abcd_ns.engine.storage.entries import Entries, LmdbEntries, MemoryEntries
from abcd_ns.engine.storage.layer_codec import FORMAT_VERSION, LayerDecodeError, decode, encode
from abcd_ns.engine.types import Crop, Layer, View

Content = tuple[tuple[int, int] | str, ...]
"""What a layer shows, in order: (block, version) pairs, or names of other parts."""


class StaleLayerError(RuntimeError):
    """A layer was drawn from an older version of its block than the store's."""


def view_fingerprint(view: View) -> str:
    """A hexadecimal digest of the pose, K, size and near plane of a camera; its index does not matter."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(f"{view.width} {view.height} {view.viewmat.dtype} {view.K.dtype} {view.near!r}".encode())
    for matrix in (view.viewmat, view.K):
        digest.update(matrix.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class LayerKey:
    """All that changes a pixel of a layer. The background does not: a layer has none."""

    scene: str
    """Fingerprint of the scene: its data and the run's constants."""
    view: str
    """`view_fingerprint` of the camera."""
    crop: Crop
    content: Content
    sh_degree: int
    """The degree of spherical harmonics in use."""
    raster_mode: Literal["classic", "antialiased"]
    rasterizer: str
    """`Rasterizer.name`: backend and version."""
    bits: Literal[16, 32]
    """Of the codec."""
    format: int = FORMAT_VERSION
    """Of the codec."""
    prefix: str = ""
    """A group, such as a visit's, that `LayerCache.drop` deletes at once. Changes no pixel, but an entry is
    found only under the prefix that it was put with."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[!-~]{0,100}", self.prefix):
            raise ValueError(f"A prefix has at most 100 printable ASCII characters; got {self.prefix!r}.")

    def digest(self) -> bytes:
        """32 bytes: blake2b of the key as canonical JSON, the prefix apart."""
        fields = asdict(self)
        del fields["prefix"]
        canonical = json.dumps(fields, sort_keys=True, separators=(",", ":"))
        return hashlib.blake2b(canonical.encode(), digest_size=32).digest()


class LayerCache:
    """A map from LayerKey to Layer under a limit of bytes, in a folder or in memory.

    Layers pass through the codec in either case, so the two give the same bits. When full, everything is
    evicted. No failure of the disk and no damaged byte raises: what cannot be kept or trusted is forgotten
    and counted. Threads may share a cache. A forked process may not; it opens its own.
    """

    def __init__(self, folder: Path | str | None, map_size: int = 2**32, bits: Literal[16, 32] = 16):
        """An empty cache in `folder`, in place of what is there, or in memory if None.

        Args:
            map_size: the limit in bytes.
            bits: of the codec; keys must agree.

        Raises:
            FolderLockedError: another process, or another cache of this one, has the folder.
            OSError: the folder cannot be made or written to.
        """
        self.bits = bits
        self._folder = None if folder is None else Path(folder)
        self.limit = map_size
        """Bytes that it may take."""
        self.hits = 0
        self.misses = 0
        self.corrupt = 0
        """Entries that were found damaged, and deleted."""
        self._entries: Entries = (
            MemoryEntries(map_size) if folder is None else LmdbEntries(Path(folder), map_size)
        )
        self._mutex = threading.Lock()
        self._process = os.getpid()

    def beside(self, name: str) -> "LayerCache":
        """A cache for a forked process: in a folder within this one's, of the same size."""
        folder = None if self._folder is None else self._folder / name
        return LayerCache(folder, self.limit, self.bits)

    def get(self, key: LayerKey) -> Layer | None:
        """The layer under `key`, or None if it was never put, was evicted or is damaged. A hit or a miss."""
        digest, address = self._address(key)
        with self._mutex:
            value = self._open_entries().get(address)
        layer, damaged = _unpack(digest, value)
        with self._mutex:
            self.hits += layer is not None
            self.misses += layer is None
            self.corrupt += damaged
            if damaged:
                self._open_entries().delete(address)
        return layer

    def put(self, key: LayerKey, layer: Layer) -> None:
        """Keep a layer, in place of what was under `key`; see `put_many`."""
        self.put_many([(key, layer)])

    def put_many(self, items: Iterable[tuple[LayerKey, Layer]]) -> None:
        """Keep several layers in one transaction, which is much faster than one by one.

        Raises:
            ValueError: NaN or infinity in a layer, or a key with other `bits`; nothing is put then.
        """
        packed = []
        for key, layer in items:
            digest, address = self._address(key)
            packed.append((address, digest + encode(layer, self.bits)))
        with self._mutex:
            self._open_entries().put_many(packed)

    def drop(self, prefix: str) -> None:
        """Delete the entries whose key has exactly this prefix."""
        with self._mutex:
            self._open_entries().drop(prefix.encode() + b"\0")

    def clear(self) -> None:
        """Delete all entries."""
        with self._mutex:
            self._open_entries().clear()

    def close(self) -> None:
        """Let go of the folder. Harmless when done twice."""
        with self._mutex:
            if os.getpid() == self._process:
                self._entries.close()

    def __enter__(self) -> "LayerCache":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        with self._mutex:
            return len(self._open_entries())

    @property
    def nbytes(self) -> int:
        """Bytes in use, of disk pages or of memory."""
        with self._mutex:
            return self._open_entries().nbytes

    @property
    def evictions(self) -> int:
        """How often the cache was full and emptied."""
        return self._entries.evictions

    @property
    def rejected(self) -> int:
        """Entries that could not be kept: larger than the limit, or refused by the disk."""
        return self._entries.rejected

    @property
    def recreated(self) -> int:
        """How often the files failed and were made anew."""
        return self._entries.recreated

    def _address(self, key: LayerKey) -> tuple[bytes, bytes]:
        """The key's digest, and where its entry lies."""
        if key.bits != self.bits or key.format != FORMAT_VERSION:
            raise ValueError(
                f"This cache keeps {self.bits} bits in format {FORMAT_VERSION}; "
                f"the key says {key.bits} bits in format {key.format}."
            )
        digest = key.digest()
        return digest, key.prefix.encode() + b"\0" + digest

    def _open_entries(self) -> Entries:
        if os.getpid() != self._process:
            raise RuntimeError("A layer cache cannot be used in a forked process; open one there.")
        return self._entries


def _unpack(digest: bytes, value: bytes | None) -> tuple[Layer | None, bool]:
    """(layer or None, whether the value is damaged).

    Values begin with their key's digest: a damaged index may lead to a sound value of another key.
    """
    if value is None:
        return None, False
    if value[: len(digest)] != digest:
        return None, True
    try:
        return decode(memoryview(value)[len(digest) :]), False
    except LayerDecodeError:
        return None, True
