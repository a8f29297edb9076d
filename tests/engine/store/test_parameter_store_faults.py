"""A store is whole or not at all, whatever disks and other programs do to it; it believes no altered byte,
and has one writer and any number of readers."""

import errno
import json
import os
import shutil
import signal
import struct
import threading
import time
from pathlib import Path

import pytest

from abcd_ns.engine.store import FolderLockedError, ParameterStore, StoreError, atomic, shard
from abcd_ns.engine.store.manifest import manifest_path
from tests.reference.store_helpers import FailAt, assert_block, block, names_in, wait_until

FAULTS = [(atomic.os, "replace", 3), (atomic.os, "fsync", 5), (shard, "save_file", 2)]
"""What a commit of two blocks calls, and how often."""


def assert_intact(store: ParameterStore) -> None:
    """The first generation, whole, and nothing else in the folder."""
    for view in (store, ParameterStore.open(store.folder, read_only=True)):
        assert (view.generation, view.blocks, view.state) == (1, [0, 7], {"clock": 5})
        assert_block(view, 0, 3, 1.0)
    assert not list(store.folder.glob(".*"))
    assert len(names_in(store.folder)) == 4


# Disks that refuse


@pytest.mark.parametrize(("module", "name", "calls"), FAULTS)
def test_a_failed_commit_leaves_the_previous_generation(store, monkeypatch, module, name, calls):
    original = getattr(module, name)
    for n in range(1, calls + 1):
        fault = FailAt(original, n)
        monkeypatch.setattr(module, name, fault)
        said = r"generation 2 failed: .*injected.* holds generation 1, intact: free space or mend the disk"
        with pytest.raises(StoreError, match=said) as raised:
            store.commit({0: block(5, 8.0), 4: block(1, 8.0)}, state={"clock": 6})
        monkeypatch.setattr(module, name, original)
        assert fault.calls >= n
        assert len(str(raised.value).splitlines()) == 1
        assert_intact(store)
    fault = FailAt(original, calls + 1)
    monkeypatch.setattr(module, name, fault)
    assert store.commit({0: block(5, 8.0), 4: block(1, 8.0)}) == 2
    assert fault.calls == calls, "FAULTS must cover every call of a commit"
    assert_block(store, 0, 5, 8.0)


@pytest.mark.parametrize(("module", "name", "calls"), FAULTS)
def test_a_disk_that_stays_broken_leaves_one_whole_generation(store, monkeypatch, module, name, calls):
    for n in range(1, calls + 1):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, FailAt(getattr(module, name), n, persistent=True))
            with pytest.raises(StoreError, match="injected"):
                store.commit({0: block(n, float(n)), 4: block(1)}, state={"clock": n})
        view = ParameterStore.open(store.folder, read_only=True)
        assert view.generation == store.generation
        rows, value = (3, 1.0) if view.generation == 1 else (n, float(n))
        assert_block(view, 0, rows, value)
        assert not list(store.folder.glob(".*"))
        if view.generation != 1:
            return


def test_an_interrupt_is_no_commit(store, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "replace", interrupt)
        with pytest.raises(KeyboardInterrupt):
            store.commit({0: block(1)})
    assert_intact(store)


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
    file = next(store.folder.glob("block-000000-*"))
    fresh = ParameterStore.open(store.folder, read_only=True)
    with monkeypatch.context() as patch:
        patch.setattr(*step, FailAt(None, 1, persistent=True))
        with pytest.raises(StoreError, match=rf"{file.name} cannot be read: .*injected"):
            fresh.load(0)
    assert_block(fresh, 0, 3, 1.0)
    monkeypatch.setattr(Path, "read_bytes", FailAt(None, 1))
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


def test_opening_what_is_no_store_says_so(tmp_path, store):
    with pytest.raises(StoreError, match="does not exist"):
        ParameterStore.open(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(StoreError, match="is no parameter store"):
        ParameterStore.open(tmp_path / "empty")
    assert names_in(tmp_path / "empty") == set()
    with pytest.raises(StoreError, match="no such pin"):
        ParameterStore.open(store.folder, "lost")
    store.close()
    with pytest.raises(StoreError, match="already holds a store"):
        ParameterStore.create(store.folder, {})
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="No store can be made in"):
        ParameterStore.create(tmp_path / "file" / "store", {})


# Files that were altered, or made to harm


@pytest.mark.parametrize("kind", ["block-000000-*", "manifest.json", "manifest-best.json"])
def test_every_flip_and_truncation_is_found(store, kind):
    store.pin("best")
    store.close()
    (file,) = store.folder.glob(kind)
    sound, pin = file.read_bytes(), "best" if "best" in kind else None
    named = pin or file.name
    for offset in range(0, len(sound), max(1, len(sound) // 150)):
        file.write_bytes(sound[:offset] + bytes([sound[offset] ^ 1 << offset % 8]) + sound[offset + 1 :])
        with pytest.raises(StoreError, match=named):
            ParameterStore.open(store.folder, pin, read_only=True).load(0)
    header = 8 + struct.unpack("<Q", sound[:8])[0] if sound[8:9] == b"{" else sound.find(b"\n") + 1
    for length in {0, 1, 7, header, len(sound) // 2, len(sound) - 1} - {len(sound)}:
        file.write_bytes(sound[:length])
        with pytest.raises(StoreError, match=named):
            ParameterStore.open(store.folder, pin, read_only=True)
    file.write_bytes(sound)
    (store.folder / "lock").write_bytes(b"")
    assert_block(ParameterStore.open(store.folder), 0, 3, 1.0)


def test_an_altered_manifest_is_found_even_if_json_reads_it_alike(store):
    store.commit({}, header={"name": "\u00e9"})
    manifest = store.folder / "manifest.json"
    sound = manifest.read_bytes()
    altered = sound.replace(rb"\u00e9", rb"\u00E9")  # one bit
    assert altered != sound
    for data in (altered, sound + b"\n"):
        manifest.write_bytes(data)
        with pytest.raises(StoreError, match=r"manifest\.json is damaged"):
            ParameterStore.open(store.folder, read_only=True)


@pytest.mark.parametrize("version", [8, 10, "9", None])
def test_older_and_newer_formats_are_named(store, version):
    store.close()
    path = manifest_path(store.folder)
    path.write_text(json.dumps({**json.loads(path.read_bytes()), "version": version}))
    with pytest.raises(StoreError, match=rf"format version {version}; this program reads version 9"):
        ParameterStore.open(store.folder)


# Writers and readers


def test_leftovers_of_a_killed_writer_are_removed(store):
    before = names_in(store.folder)
    store.close()
    for name in (".manifest.json.0a1b2c3d.tmp", ".tmpAbCdEf", "block-000000-00000002.safetensors"):
        (store.folder / name).write_bytes(b"half")
    ParameterStore.open(store.folder, read_only=True)
    assert names_in(store.folder) > before
    ParameterStore.open(store.folder).close()
    assert names_in(store.folder) == before


def hold_locked(folder: Path, writes: int) -> None:
    """The body of a process that holds the lock, and has a worker, whose number it writes."""
    try:
        lock = atomic.FolderLock(folder)
        worker = os.fork()  # shares the open lock file, as a data loader's worker does
        if worker:
            os.write(writes, str(worker).encode())
        time.sleep(60)
        del lock
    finally:
        os._exit(1)


def test_a_second_writer_is_refused_until_the_first_is_killed(store):
    with pytest.raises(FolderLockedError, match=f"process {os.getpid()}"):
        ParameterStore.open(store.folder)
    store.close()
    reads, writes = os.pipe()
    holder = os.fork()
    if holder == 0:
        hold_locked(store.folder, writes)
    os.close(writes)
    worker = int(os.read(reads, 20))
    os.close(reads)
    try:
        with pytest.raises(FolderLockedError, match=f"{store.folder}.*process {holder}"):
            ParameterStore.open(store.folder)
        assert_block(ParameterStore.open(store.folder, read_only=True), 0, 3, 1.0)
        os.kill(holder, signal.SIGKILL)
        os.waitpid(holder, 0)
        with ParameterStore.open(store.folder) as again:  # though the worker lives on
            again.commit({0: block(1, 1.0)})
    finally:
        os.kill(worker, signal.SIGKILL)


def test_a_reader_of_a_replaced_generation_is_told(store):
    reader = ParameterStore.open(store.folder, read_only=True)
    store.commit({0: block(1, 2.0)})
    with pytest.raises(StoreError, match="newer generation"):
        reader.load(0)
    assert_block(reader, 7, 0, 2.0)


@pytest.mark.parametrize("reopens", [False, True])
def test_readers_see_old_or_new_and_never_a_mixture(store, monkeypatch, reopens):
    """Another thread that loads from the writer's own store, or opens the folder again and again."""
    monkeypatch.setattr(atomic.os, "fsync", lambda _: None)  # matters to no reader, and takes long
    store.commit({0: block(20, 0.0), 7: block(9, 0.0)}, state={"value": 0.0})
    mixed, seen, done = [], [], threading.Event()

    def read():
        view = store
        while not done.is_set():
            try:
                if reopens:
                    view = ParameterStore.open(store.folder, read_only=True)
                loaded = [view.load(number) for number in (0, 7)]
            except StoreError as error:
                if not reopens or "newer generation" not in str(error):
                    mixed.append(str(error))
                continue
            found = [{meta["value"], *tensors["features_rest"].unique().tolist()} for tensors, meta in loaded]
            seen.append(found[0])
            wanted = {view.state["value"]}
            if found != [wanted] * 2 if reopens else {len(values) for values in found} != {1}:
                mixed.append(f"{found} in a generation of {wanted}")

    thread = threading.Thread(target=read)
    thread.start()
    wait_until(lambda: seen)
    for value in range(1, 101):
        fresh = {0: block(20, float(value)), 7: block(9, float(value))}
        store.commit(fresh, state={"value": float(value)})
    done.set()
    thread.join()
    assert mixed == []
    assert len(set(map(min, seen))) > 1
