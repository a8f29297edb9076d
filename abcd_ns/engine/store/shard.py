"""One block's tensors in one safetensors file, which is written once and never changed."""

import errno
import hashlib
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from abcd_ns.engine.store.atomic import replacing
from abcd_ns.engine.store.manifest import Shard, StoreError
from abcd_ns.engine.store.special_blocks import BlockName

_CHUNK = 1 << 20


def write_shard(
    folder: Path, block: BlockName, generation: int, tensors: Mapping[str, Tensor], meta: dict[str, Any]
) -> Shard:
    """Write a block and sync it; the folder is left for the caller to sync. If the disk refuses, by OSError
    or SafetensorError, nothing is left behind."""
    name = block if isinstance(block, str) else f"{block:06d}"
    path = folder / f"block-{name}-{generation:08d}.safetensors"
    with replacing(path) as temporary:
        save_file(_plain(tensors), temporary)
        with open(temporary, "rb") as file:
            checksum = _checksum(file)
            nbytes = file.tell()
    rows = tensors["means"].shape[0] if "means" in tensors else 0
    return Shard(path.name, generation, nbytes, checksum, rows, meta)


def verify_shard(path: Path, shard: Shard) -> None:
    """Compare every byte of the file with the manifest. Raises StoreError where it differs, or OSError."""
    with open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size != shard.nbytes or _checksum(file) != shard.checksum:
            raise StoreError(f"{path} is damaged: its checksum is wrong. Go back to a pinned generation.")


def read_shard(path: Path, names: Iterable[str] | None) -> dict[str, Tensor]:
    """The tensors of these names, or all, on the CPU. Raises OSError or SafetensorError."""
    try:
        file = safe_open(path, framework="pt", device="cpu")
    except RuntimeError as error:  # torch maps the file, and has no OSError of its own
        if not path.exists():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path)) from error
        raise OSError(str(error)) from error
    with file:
        wanted = sorted(file.keys()) if names is None else names
        # Copies own their memory: views of the mapped file would crash the process if the disk failed later.
        return {name: file.get_tensor(name).clone() for name in wanted}


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file a second name, or a second copy where links are impossible. Replaces `target`."""
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise
    except OSError:  # another file system, or one without links
        with replacing(target) as temporary:
            shutil.copyfile(source, temporary)


def _plain(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """As safetensors wants them: on the CPU, contiguous, and none sharing memory with another."""
    plain, storages = dict[str, Tensor](), set[int]()
    for name, tensor in tensors.items():
        value = tensor.detach().to("cpu", memory_format=torch.preserve_format).contiguous()
        storage = value.untyped_storage().data_ptr()
        plain[name] = value.clone() if storage in storages else value
        storages.add(storage)
    return plain


def _checksum(file: BinaryIO) -> str:
    """blake2b of what is left of an open file, read in pieces."""
    digest = hashlib.blake2b(digest_size=16)
    while piece := file.read(_CHUNK):
        digest.update(piece)
    return digest.hexdigest()
