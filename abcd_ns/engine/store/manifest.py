"""The one small file that says which shards make up a generation of a store."""

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from abcd_ns.engine.store.special_blocks import BlockName, from_text, in_order
from abcd_ns.errors import UserError

FORMAT = "abcd-parameter-store"
FORMAT_VERSION = 9


class StoreError(UserError):
    """The store cannot do what was asked; the message names the file and what to do."""


@dataclass(frozen=True)
class Shard:
    """What the manifest says of one block."""

    file: str
    generation: int  # the generation that wrote it: the block's version
    nbytes: int
    checksum: str  # blake2b of the whole file, hexadecimal
    rows: int  # rows of the tensor "means"
    meta: dict[str, Any]  # the block's JSON: known without opening the file


@dataclass(frozen=True)
class Manifest:
    """One generation of a store."""

    generation: int
    header: dict[str, Any]
    state: dict[str, Any]
    blocks: dict[BlockName, Shard]

    @property
    def files(self) -> set[str]:
        return {shard.file for shard in self.blocks.values()}

    def to_bytes(self) -> bytes:
        """As JSON. Raises TypeError or ValueError where something is not JSON."""
        blocks = {str(block): vars(self.blocks[block]) for block in in_order(self.blocks)}
        return _in_envelope(_compact({**vars(self), "blocks": blocks}))

    @staticmethod
    def from_bytes(data: bytes, path: Path) -> "Manifest":
        """The manifest in the file `path`; StoreError for another version, or a single altered byte."""
        try:
            envelope = json.loads(data)
        except ValueError as error:
            raise StoreError(f"{path} is damaged: it is not JSON ({error}).") from error
        if not isinstance(envelope, dict) or envelope.get("format") != FORMAT:
            raise StoreError(f"{path} is not the manifest of a parameter store.")
        version = envelope.get("version")
        if version != FORMAT_VERSION:
            raise StoreError(
                f"{path} has format version {version}; this program reads version {FORMAT_VERSION}. "
                "Open it with the program that wrote it."
            )
        body = envelope.get("body")
        # Comparing bytes finds alterations, too, that JSON reads as the same value.
        if _in_envelope(_compact(body)) != data:
            raise StoreError(f"{path} is damaged: its checksum is wrong. Restore it from a pin or a copy.")
        blocks = {from_text(block): Shard(**shard) for block, shard in body["blocks"].items()}
        return Manifest(body["generation"], body["header"], body["state"], blocks)


def manifest_path(folder: Path, name: str | None = None) -> Path:
    """Where the present manifest lies, or the one pinned under `name`, which may not leave the folder."""
    if name is None:
        return folder / "manifest.json"
    if not re.fullmatch(r"[A-Za-z0-9_.-]{1,100}", name):
        raise ValueError(f"A pin's name may hold letters, digits, '_', '-' and '.'; got {name!r}.")
    return folder / f"manifest-{name}.json"


def pin_names(folder: Path) -> list[str]:
    """The names under which generations of the store in `folder` are pinned."""
    return sorted(path.stem.removeprefix("manifest-") for path in folder.glob("manifest-*.json"))


def read_manifest(path: Path) -> Manifest:
    """The manifest in a file; StoreError where it is missing, unreadable, of another format or damaged."""
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        what = "is no parameter store" if path.stem == "manifest" else "has no such pin"
        raise StoreError(f"{path.parent} {what}: it has no {path.name}; check the name.") from error
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror}.") from error
    return Manifest.from_bytes(data, path)


def read_checked_manifest(path: Path) -> Manifest:
    """As `read_manifest`; StoreError also where a shard is missing, or has another size."""
    while True:
        manifest = read_manifest(path)
        try:
            for shard in manifest.blocks.values():
                _check_size(path.parent / shard.file, shard)
            return manifest
        except StoreError:
            if read_manifest(path) == manifest:
                raise
            # A writer has committed meanwhile, and deleted shards of the generation read here.


def _check_size(path: Path, shard: Shard) -> None:
    try:
        nbytes = path.stat().st_size
    except OSError as error:
        raise StoreError(f"{path} cannot be read: {error.strerror}.") from error
    if nbytes != shard.nbytes:
        raise StoreError(f"{path} is damaged: it should have {shard.nbytes} bytes but has {nbytes}.")


def _compact(body: Any) -> bytes:
    return json.dumps(body, separators=(",", ":")).encode()


def _in_envelope(body: bytes) -> bytes:
    checksum = hashlib.blake2b(body, digest_size=16).hexdigest()
    head = f'{{"format":"{FORMAT}","version":{FORMAT_VERSION},"checksum":"{checksum}","body":'
    return head.encode() + body + b"}"
