"""A store is whole or not at all, believes no altered byte, and has one writer and any number of readers."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from abcd_ns.engine.store import FolderLockedError, ParameterStore, StoreError, atomic, shard
from abcd_ns.engine.store.manifest import FORMAT_VERSION
from tests.reference.store_helpers import FailAt, assert_block, block, names_in

FAULTS = [(atomic.os, "replace", 3), (atomic.os, "fsync", 5), (shard, "save_file", 2)]


@pytest.mark.parametrize(("module", "name", "calls"), FAULTS)
def test_a_failed_commit_leaves_the_previous_generation(store, monkeypatch, module, name, calls):
    before = names_in(store.folder)
    original = getattr(module, name)
    for n in range(1, calls + 1):
        fault = FailAt(original, n)
        monkeypatch.setattr(module, name, fault)
        with pytest.raises(StoreError, match=r"generation 2 failed: .*injected.* holds generation 1"):
            store.commit({0: block(5, 8.0), 4: block(1, 8.0)}, state={"clock": 6})
        monkeypatch.setattr(module, name, original)
        assert fault.calls >= n
        assert names_in(store.folder) == before
        for view in (store, ParameterStore.open(store.folder, read_only=True)):
            assert (view.generation, view.blocks, view.state) == (1, [0, 7], {"clock": 5})
            assert_block(view, 0, 3, 1.0)
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

    before = names_in(store.folder)
    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "replace", interrupt)
        with pytest.raises(KeyboardInterrupt):
            store.commit({0: block(1)})
    assert names_in(store.folder) == before
    assert_block(store, 0, 3, 1.0)


def test_too_little_space_is_found_before_writing(store, monkeypatch):
    usage = type("Usage", (), {"free": 100})
    monkeypatch.setattr("abcd_ns.engine.store.parameter_store.shutil.disk_usage", lambda _: usage)
    monkeypatch.setattr(shard, "save_file", FailAt(None, 1))
    with pytest.raises(StoreError, match=r"0 MiB free.*needs.*Free space"):
        store.commit({0: block(50)})


@pytest.mark.parametrize("kind", ["shard", "manifest"])
def test_every_flip_and_truncation_is_found(store, kind):
    file = next(store.folder.glob("block-000000-*")) if kind == "shard" else store.folder / "manifest.json"
    store.close()
    sound = file.read_bytes()
    flips = [(offset, 1 << (offset % 8)) for offset in range(0, len(sound), max(1, len(sound) // 150))]
    for offset, mask in flips:
        file.write_bytes(sound[:offset] + bytes([sound[offset] ^ mask]) + sound[offset + 1 :])
        with pytest.raises(StoreError, match=file.name):
            ParameterStore.open(store.folder, read_only=True).load(0)
    for length in (0, 1, 7, len(sound) // 2, len(sound) - 1):
        file.write_bytes(sound[:length])
        with pytest.raises(StoreError, match=file.name):
            ParameterStore.open(store.folder, read_only=True)
    file.write_bytes(sound)
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


def test_load_of_some_tensors_checks_each_file_once(store):
    file = next(store.folder.glob("block-000000-*"))
    fresh = ParameterStore.open(store.folder, read_only=True)
    sound = file.read_bytes()
    file.write_bytes(sound[:-1] + bytes([sound[-1] ^ 1]))
    with pytest.raises(StoreError, match="checksum"):
        fresh.load(0, ["means"])
    file.write_bytes(sound)
    fresh.load(0, ["means"])
    file.write_bytes(sound[:-1] + bytes([sound[-1] ^ 1]))
    fresh.load(0, ["means"])
    with pytest.raises(StoreError, match="checksum"):
        fresh.load(0)


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
    manifest = store.folder / "manifest.json"
    newer = FORMAT_VERSION + 1
    head = b'"version":%d'
    manifest.write_bytes(manifest.read_bytes().replace(head % FORMAT_VERSION, head % newer))
    with pytest.raises(StoreError, match=rf"format version {newer}.*version {FORMAT_VERSION}"):
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


HOLDER = """
import os, pathlib, runpy, sys, time
lock = runpy.run_path(sys.argv[1])["FolderLock"](pathlib.Path(sys.argv[2]))
worker = os.fork()  # shares the open lock file, as a data loader's worker does
if worker:
    print(worker, flush=True)
time.sleep(60)
"""


def test_a_second_writer_is_refused_until_the_first_is_killed(store):
    with pytest.raises(FolderLockedError, match=f"process {os.getpid()}"):
        ParameterStore.open(store.folder)
    store.close()
    # atomic.py alone: importing the package would take seconds.
    command = [sys.executable, "-c", HOLDER, atomic.__file__, str(store.folder)]
    holder = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    worker = None
    try:
        worker = int(holder.stdout.readline())
        with pytest.raises(FolderLockedError, match=f"{store.folder}.*process {holder.pid}"):
            ParameterStore.open(store.folder)
        assert_block(ParameterStore.open(store.folder, read_only=True), 0, 3, 1.0)
        holder.kill()
        holder.wait()
        with ParameterStore.open(store.folder) as again:  # though the worker lives on
            again.commit({0: block(1, 1.0)})
    finally:
        holder.kill()
        holder.wait()
        holder.stdout.close()
        if worker is not None:
            os.kill(worker, signal.SIGKILL)


def test_a_reader_of_a_replaced_generation_is_told(store):
    reader = ParameterStore.open(store.folder, read_only=True)
    store.commit({0: block(1, 2.0)})
    with pytest.raises(StoreError, match="newer generation"):
        reader.load(0)
    assert_block(reader, 7, 0, 2.0)


def test_threads_read_old_or_new_but_never_a_mixture(store):
    store.commit({0: block(20, 1.0)}, state={"value": 1, "again": 1})
    problems, done = [], threading.Event()

    def read():
        while not done.is_set():
            tensors, meta = store.load(0)
            if not (tensors["features_rest"] == meta["value"]).all():
                problems.append(meta)

    def reopen():
        while not done.is_set():
            view = ParameterStore.open(store.folder, read_only=True)
            if view.state["value"] != view.state["again"]:
                problems.append(view.state)

    threads = [threading.Thread(target=work) for work in (read, reopen)]
    for thread in threads:
        thread.start()
    for value in range(2, 40):
        store.commit({0: block(20, float(value))}, state={"value": value, "again": value})
    done.set()
    for thread in threads:
        thread.join()
    assert not problems
