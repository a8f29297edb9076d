"""The layer cache gives back the layer of exactly this key, or none; and nothing makes it raise."""

import os
import resource
import threading
from dataclasses import replace
from pathlib import Path

import lmdb
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from abcd_ns.engine.storage import (
    FolderLockedError,
    LayerCache,
    LayerKey,
    entries,
)
from abcd_ns.engine.storage.layer_codec import decode, encode
from abcd_ns.engine.types import Crop, Layer

MIB = 2**20


def key(index: int = 0, prefix: str = "", bits: int = 16) -> LayerKey:
    return LayerKey(
        scene="scene",
        view=f"view {index}",
        crop=Crop(0, 16, 4, 4),
        content=((1, 2), (3, 4), "far"),
        sh_degree=3,
        raster_mode="classic",
        rasterizer="torch-1",
        bits=bits,
        prefix=prefix,
    )


def layer(seed: int, size: int = 4) -> Layer:
    generator = torch.Generator().manual_seed(seed)
    return Layer(
        2 * torch.rand(size, size, 3, generator=generator), torch.rand(size, size, generator=generator)
    )


def same(a: Layer, b: Layer) -> bool:
    return torch.equal(a.color, b.color) and torch.equal(a.transmittance, b.transmittance)


@pytest.fixture(params=["disk", "memory"])
def cache(request, tmp_path):
    with LayerCache(tmp_path / "cache" if request.param == "disk" else None, MIB) as cache:
        yield cache


# A map from keys to layers


def test_what_was_put_is_found_and_counted(cache):
    assert cache.get(key(1)) is None
    cache.put(key(1), layer(1))
    found = cache.get(key(1))
    assert same(found, decode(encode(layer(1), 16)))
    assert cache.get(replace(key(1), sh_degree=0)) is None
    assert (cache.hits, cache.misses, cache.corrupt, len(cache)) == (1, 2, 0, 1)
    assert 0 < cache.nbytes <= MIB


@pytest.mark.parametrize("folder", ["disk", None])
def test_32_bits_are_exact(tmp_path, folder):
    with LayerCache(folder and tmp_path / folder, MIB, bits=32) as cache:
        cache.put(key(bits=32), layer(1))
        assert same(cache.get(key(bits=32)), layer(1))
        for call in (cache.get, lambda k: cache.put(k, layer(1))):
            with pytest.raises(ValueError, match="32 bits"):
                call(key(bits=16))


def test_dropping_a_prefix_leaves_the_others(cache):
    prefixes = ["", "visit-1", "visit-12", "visit-2"]
    cache.put_many((key(i, prefix), layer(i)) for prefix in prefixes for i in range(5))
    cache.drop("visit-1")
    cache.drop("unknown")
    left = {prefix: sum(cache.get(key(i, prefix)) is not None for i in range(5)) for prefix in prefixes}
    assert left == {"": 5, "visit-1": 0, "visit-12": 5, "visit-2": 5}
    cache.clear()
    assert len(cache) == 0
    assert cache.get(key(0)) is None


def test_a_diverged_layer_is_refused(cache):
    bad = layer(1)
    bad.color[0, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="NaN"):
        cache.put_many([(key(1), layer(1)), (key(2), bad)])
    assert len(cache) == 0


def test_a_full_cache_goes_on(cache):
    for i in range(60):
        cache.put(key(i), layer(i, 64))
        assert cache.nbytes <= MIB
        assert same(cache.get(key(i)), decode(encode(layer(i, 64), 16)))
    assert cache.evictions > 0
    cache.put_many((key(i), layer(i, 64)) for i in range(60))
    assert 0 < cache.nbytes <= MIB
    assert cache.get(key(59)) is not None
    assert cache.rejected == cache.corrupt == cache.recreated == 0


def test_a_layer_above_the_limit_is_rejected_and_evicts_nothing(cache):
    cache.put(key(1), layer(1))
    cache.put(key(2), layer(2, 500))
    assert cache.rejected == 1
    assert cache.get(key(1)) is not None
    assert cache.get(key(2)) is None


@pytest.mark.parametrize("folder", ["disk", None])
def test_no_room_at_all_is_a_cache_that_misses(tmp_path, folder):
    with LayerCache(folder and tmp_path / folder, 0) as cache:
        cache.put(key(1), layer(1, 200))
        assert cache.get(key(1)) is None


def test_threads_share_a_cache(cache):
    cache.put_many((key(i), layer(i)) for i in range(20))
    expected = [decode(encode(layer(i), 16)) for i in range(20)]
    wrong = []

    def read(start):
        for i in range(200):
            n = (start + i) % 20
            found = cache.get(key(n))
            if found is None or not same(found, expected[n]):
                wrong.append(n)

    threads = [threading.Thread(target=read, args=(5 * i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for i in range(30):
        cache.put(key(100 + i), layer(i))
    for thread in threads:
        thread.join()
    assert not wrong
    assert cache.hits == 800


def test_a_forked_process_is_told_to_open_its_own(cache, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: -1)
        with pytest.raises(RuntimeError, match="forked"):
            cache.get(key())


# Folders


def test_a_cache_begins_empty(tmp_path):
    with LayerCache(tmp_path, MIB) as cache:
        cache.put(key(1), layer(1))
        with pytest.raises(FolderLockedError, match="being written"):
            LayerCache(tmp_path, MIB)
    cache.close()
    with pytest.raises(RuntimeError, match="closed"):
        cache.get(key(1))
    with LayerCache(tmp_path, MIB) as cache:
        assert cache.get(key(1)) is None
        assert (len(cache), cache.recreated) == (0, 0)


def test_files_that_are_no_cache_are_replaced_and_others_left(tmp_path):
    (tmp_path / "data.mdb").write_bytes(b"garbage" * 5000)
    (tmp_path / "notes.txt").write_text("mine")
    with LayerCache(tmp_path, MIB) as cache:
        cache.put(key(1), layer(1))
        assert cache.get(key(1)) is not None
    assert (tmp_path / "notes.txt").read_text() == "mine"


def alter(cache: LayerCache, change) -> None:
    """Replace the values in a cache by what `change` makes of the list of them."""
    with cache._entries._environment.begin(write=True) as transaction:
        items = list(transaction.cursor())
        for (name, _), value in zip(items, change([value for _, value in items]), strict=True):
            transaction.put(name, value)


@pytest.mark.parametrize(
    "change",
    [
        lambda values: [values[1], values[0]],
        lambda values: [value[:-1] for value in values],
        lambda values: [value[:40] for value in values],
        lambda values: [b"" for _ in values],
        lambda values: [value[:60] + bytes([value[60] ^ 4]) + value[61:] for value in values],
    ],
    ids=["swapped", "short", "header only", "empty", "flipped"],
)
def test_damaged_entries_are_misses_and_are_deleted(tmp_path, change):
    with LayerCache(tmp_path, MIB) as cache:
        cache.put_many([(key(0), layer(0)), (key(1), layer(1))])
        alter(cache, change)
        assert cache.get(key(0)) is cache.get(key(1)) is None
        assert (cache.corrupt, cache.misses, cache.hits, len(cache)) == (2, 2, 0, 0)
        assert cache.get(key(0)) is None
        assert cache.corrupt == 2


@given(st.data())
@settings(max_examples=20)
def test_flipped_bytes_of_values_never_reach_a_layer(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("flips")
    with LayerCache(folder, MIB) as cache, open(folder / "data.mdb", "r+b") as file:
        cache.put(key(0), layer(0, 40))
        value = key(0).digest() + encode(layer(0, 40), 16)
        place = file.read().index(value) + data.draw(st.integers(0, len(value) - 1))
        file.seek(place)
        flipped = file.read(1)[0] ^ 1 << data.draw(st.integers(0, 7))
        file.seek(place)
        file.write(bytes([flipped]))
        file.flush()
        assert cache.get(key(0)) is None
        assert cache.corrupt == 1


def test_a_full_disk_is_a_cache_that_misses(tmp_path):
    with LayerCache(tmp_path, 64 * MIB) as cache:
        cache.put(key(0), layer(0))
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (MIB, hard))
        try:
            cache.put_many((key(i), layer(i, 300)) for i in range(10))
            assert cache.get(key(0)) is None or same(cache.get(key(0)), decode(encode(layer(0), 16)))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        cache.put(key(1), layer(1, 300))
        assert same(cache.get(key(1)), decode(encode(layer(1, 300), 16)))


def test_lmdb_failing_is_a_miss_and_passes(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise lmdb.DiskError("no such disk")

    with LayerCache(tmp_path, MIB) as cache:
        cache.put(key(0), layer(0))
        cache._entries._environment.close()  # every later call of LMDB raises
        assert cache.get(key(0)) is None
        assert cache.recreated == 1
        cache.put(key(0), layer(0))
        assert cache.get(key(0)) is not None

        with monkeypatch.context() as patch:
            patch.setattr(entries.lmdb, "open", fail)
            cache.clear()
            cache.put(key(1), layer(1))
            assert cache.get(key(1)) is None
            assert (len(cache), cache.nbytes, cache.rejected) == (0, 0, 1)
        cache.put(key(2), layer(2))
        assert cache.get(key(2)) is not None
    with monkeypatch.context() as patch:
        patch.setattr(entries.lmdb, "open", fail)
        with pytest.raises(OSError, match="no such disk"):
            LayerCache(tmp_path, MIB)
    LayerCache(tmp_path, MIB).close()


class CacheMachine(RuleBasedStateMachine):
    """Both kinds of cache against a dictionary."""

    indices = st.integers(0, 5)
    prefixes = st.sampled_from(["", "a", "ab"])

    def __init__(self):
        super().__init__()
        self.folder = Path(CacheMachine.base.mktemp("cache"))
        self.caches = [LayerCache(self.folder, MIB), LayerCache(None, MIB)]
        self.model: dict[LayerKey, Layer] = {}

    @rule(items=st.lists(st.tuples(indices, prefixes, st.integers(0, 99)), max_size=4))
    def put(self, items):
        layers = [(key(index, prefix), layer(seed)) for index, prefix, seed in items]
        for cache in self.caches:
            cache.put_many(layers)
        self.model |= {k: decode(encode(value, 16)) for k, value in layers}

    @rule(prefix=prefixes)
    def drop(self, prefix):
        for cache in self.caches:
            cache.drop(prefix)
        self.model = {k: value for k, value in self.model.items() if k.prefix != prefix}

    @rule()
    def clear(self):
        for cache in self.caches:
            cache.clear()
        self.model = {}

    @rule()
    def reopen(self):
        self.caches[0].close()
        self.caches[0] = LayerCache(self.folder, MIB)
        self.caches[1].clear()
        self.model = {}

    @invariant()
    def agree(self):
        for cache in self.caches:
            assert len(cache) == len(self.model)
            for k, expected in self.model.items():
                assert same(cache.get(k), expected)
            assert cache.misses == cache.corrupt == cache.recreated == 0

    def teardown(self):
        for cache in self.caches:
            cache.close()


def test_the_cache_is_a_dictionary(tmp_path_factory):
    CacheMachine.base = tmp_path_factory
    case = CacheMachine.TestCase
    case.settings = settings(max_examples=15, stateful_step_count=12, deadline=None, derandomize=True)
    case().runTest()
