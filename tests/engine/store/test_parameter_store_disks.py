"""What disks and other programs do to a store: full, read-only, gone, failing, and files made to harm."""

import errno
import json
import multiprocessing
import os
import resource
import shutil
import struct
from pathlib import Path

import pytest

from abcd_ns.engine.store import ParameterStore, StoreError, atomic, shard
from abcd_ns.engine.store.manifest import Manifest, manifest_path, read_manifest
from tests.reference.store_helpers import FailAt, assert_block, block, names_in


def assert_intact(store: ParameterStore) -> None:
    """The first generation, whole, and nothing else in the folder."""
    for view in (store, ParameterStore.open(store.folder, read_only=True)):
        assert (view.generation, view.blocks, view.state) == (1, [0, 7], {"clock": 5})
        assert_block(view, 0, 3, 1.0)
    assert not list(store.folder.glob(".*"))
    assert len(names_in(store.folder)) == 4


# Disks that refuse


def test_a_disk_that_is_full_at_any_byte_leaves_the_previous_generation(store):
    """RLIMIT_FSIZE makes every write beyond a size fail, in Python, in safetensors, wherever it happens."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    sizes = {path.name: path.stat().st_size for path in store.folder.iterdir()}
    largest, refused = max(sizes.values()), 0
    try:
        for limit in (0, 1, 100, 300, sizes["manifest.json"] - 1, largest - 1):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
            with pytest.raises(StoreError, match=r"generation 2 failed: .* holds generation 1, intact"):
                store.commit({0: block(5, 8.0), 4: block(40, 8.0)}, state={"clock": 6})
            refused += 1
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            assert_intact(store)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert refused == 6
    assert store.commit({0: block(5, 8.0)}) == 2
    assert_block(store, 0, 5, 8.0)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_the_nth_write_that_fails_is_one_clear_line(store, monkeypatch, code):
    for n in (1, 2, 3):
        with monkeypatch.context() as patch:
            patch.setattr(shard, "save_file", FailAt(shard.save_file, n, code=code))
            patch.setattr(Path, "write_bytes", FailAt(Path.write_bytes, max(n - 2, 1), code=code))
            with pytest.raises(StoreError) as raised:
                store.commit({0: block(5, 8.0), 4: block(1, 8.0)})
        assert len(str(raised.value).splitlines()) == 1
        assert "intact: free space or mend the disk" in str(raised.value)
        assert_intact(store)
    assert store.commit({0: block(5, 8.0), 4: block(1, 8.0)}) == 2


def test_a_pin_that_cannot_be_written_leaves_the_others(store, monkeypatch):
    store.pin("best")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", FailAt(None, 1, persistent=True, code=errno.ENOSPC))
        with pytest.raises(StoreError, match=r"manifest-other\.json could not be written"):
            store.pin("other")
        with pytest.raises(StoreError, match=r"'best' could not be restored.*holds generation 1"):
            store.restore("best")
    assert store.pins == ["best"]
    assert store.restore("best") == 2


@pytest.mark.parametrize("step", [(shard, "safe_open"), (shard, "_checksum")], ids=["tensors", "bytes"])
def test_a_disk_that_fails_while_reading_says_which_file(store, monkeypatch, step):
    module, name = step
    file = next(store.folder.glob("block-000000-*"))
    fresh = ParameterStore.open(store.folder, read_only=True)
    with monkeypatch.context() as patch:
        patch.setattr(module, name, FailAt(None, 1, persistent=True))
        with pytest.raises(StoreError, match=rf"{file.name} cannot be read: .*injected"):
            fresh.load(0)
    assert_block(fresh, 0, 3, 1.0)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", FailAt(None, 1))
        with pytest.raises(StoreError, match=r"manifest\.json cannot be read"):
            ParameterStore.open(store.folder, read_only=True)


def test_a_folder_that_is_read_only_can_be_read_and_not_written(store, monkeypatch):
    store.close()
    opened = os.open

    def read_only(path, flags, *rest, **options):
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, "Read-only file system")
        return opened(path, flags, *rest, **options)

    monkeypatch.setattr(atomic.os, "open", read_only)
    with pytest.raises(StoreError, match="is not writable: Read-only file system; open it read-only"):
        ParameterStore.open(store.folder)
    with pytest.raises(StoreError, match=r"No store can be made in .*: Read-only file system"):
        ParameterStore.create(store.folder.with_name("new"), {})
    assert_block(ParameterStore.open(store.folder, read_only=True), 0, 3, 1.0)


def test_a_folder_that_is_deleted_under_a_run_is_an_error_and_no_crash(store):
    shutil.rmtree(store.folder)
    with pytest.raises(StoreError, match="is gone: deleted"):
        store.load(0)
    with pytest.raises(StoreError, match=r"generation 2 failed: .*No such file.*manifest"):
        store.commit({0: block(1)})
    with pytest.raises(StoreError, match="does not exist"):
        ParameterStore.open(store.folder)


def test_a_store_under_a_file_says_so(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="No store can be made in"):
        ParameterStore.create(tmp_path / "file" / "store", {})


# Files that were altered, or made to harm


def test_every_file_of_a_store_cut_short_anywhere_is_found(store):
    store.pin("best")
    store.close()
    for path in sorted(store.folder.iterdir()):
        sound = path.read_bytes()
        for length in {0, 1, header_length(sound) - 1, len(sound) // 2, len(sound) - 1}:
            if path.name == "lock" or length >= len(sound):
                continue
            path.write_bytes(sound[:length])
            name = "best" if "best" in path.name else None
            with pytest.raises(StoreError, match=path.name):
                ParameterStore.open(store.folder, name, read_only=True)
        path.write_bytes(sound)
    (store.folder / "lock").write_bytes(b"")
    assert_block(ParameterStore.open(store.folder), 0, 3, 1.0)


def header_length(data: bytes) -> int:
    """Of a safetensors file; of any other, its first line."""
    if data[8:9] == b"{":
        return 8 + struct.unpack("<Q", data[:8])[0]
    return data.find(b"\n") + 1 or len(data)


def test_every_flipped_bit_of_a_pin_is_found(store):
    store.pin("best")
    path = manifest_path(store.folder, "best")
    sound = path.read_bytes()
    for offset in range(len(sound)):
        path.write_bytes(sound[:offset] + bytes([sound[offset] ^ 1 << offset % 8]) + sound[offset + 1 :])
        with pytest.raises(StoreError, match="best"):
            ParameterStore.open(store.folder, "best")
    path.write_bytes(sound)
    assert ParameterStore.open(store.folder, "best").generation == 1


@pytest.mark.parametrize("version", [5, 7, "6", None])
def test_older_and_newer_formats_are_named(store, version):
    store.close()
    path = manifest_path(store.folder)
    envelope = json.loads(path.read_bytes())
    path.write_text(json.dumps({**envelope, "version": version}))
    with pytest.raises(StoreError, match=rf"format version {version}; this program reads version 6"):
        ParameterStore.open(store.folder)


@pytest.mark.parametrize("claim", ["elements", "header"])
def test_a_shard_that_claims_more_than_it_has_is_refused(store, claim):
    """Its checksum is right: whoever made it wanted it to be read."""
    path = next(store.folder.glob("block-000000-*"))
    tensor = {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}
    header = json.dumps({"means": tensor}).encode()
    length = 2**40 if claim == "header" else len(header)
    store.close()
    path.write_bytes(struct.pack("<Q", length) + header + bytes(64))
    forge(store.folder, path)
    with pytest.raises(StoreError, match=f"{path.name} cannot be read"):
        ParameterStore.open(store.folder, read_only=True).load(0)


def forge(folder: Path, path: Path) -> None:
    """Make the manifest agree with a file that was put in place of a shard."""
    old = read_manifest(manifest_path(folder))
    with open(path, "rb") as file:
        altered = shard.Shard(path.name, 1, path.stat().st_size, shard._checksum(file), 3, {})
    new = Manifest(old.generation, old.header, old.state, {**old.blocks, 0: altered})
    manifest_path(folder).write_bytes(new.to_bytes())


# A reader while another process commits


def test_a_reader_sees_a_thousand_commits_old_or_new_and_never_mixed(store, monkeypatch):
    """Whether a file is synced matters to no reader, and syncing takes long."""
    monkeypatch.setattr(atomic.os, "fsync", lambda _: None)
    store.commit({0: block(20, 0.0), 7: block(9, 0.0)}, state={"value": 0.0})
    context = multiprocessing.get_context("fork")
    stop, seen = context.Event(), context.Queue()
    reader = context.Process(target=read_until, args=(store.folder, stop, seen))
    reader.start()
    assert seen.get(timeout=60) == "ready"
    for value in range(1, 1001):
        fresh = {0: block(20, float(value)), 7: block(9, float(value))}
        store.commit(fresh, state={"value": float(value)})
    stop.set()
    generations, mixed = seen.get(timeout=60)
    reader.join()
    assert mixed == []
    assert len(generations) > 1
    assert generations == sorted(generations)


def read_until(folder: Path, stop, seen) -> None:
    """Open the store again and again; a generation that is replaced while it is read says so."""
    generations, mixed = [], []
    seen.put("ready")
    while not stop.is_set():
        view = ParameterStore.open(folder, read_only=True)
        try:
            found = [float(view.load(number)[1]["value"]) for number in (0, 7)]
        except StoreError as error:
            if "newer generation" not in str(error):
                mixed.append(str(error))
            continue
        if found != [view.state["value"]] * 2:
            mixed.append(f"{found} in a generation of {view.state['value']}")
        if view.generation not in generations[-1:]:
            generations.append(view.generation)
    seen.put((generations, mixed))
