"""Store and cache together are dictionaries: commits, layers, evictions, kills and reopening in any order."""

import shutil
from pathlib import Path

import torch
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from abcd_ns.engine.storage import LayerCache, LayerKey, ParameterStore, crash_points
from abcd_ns.engine.storage.layer_codec import through_codec
from abcd_ns.engine.types import Crop, Layer
from tests.engine.store_helpers import assert_block, block

BLOCKS = st.integers(0, 3)
CONTENT = st.tuples(st.integers(1, 3), st.integers(0, 99))
CACHE_BYTES = 1 << 18


def layer_of(number: int, value: int) -> Layer:
    """What the cache should hold of a block with this content; large, so that a few fill the cache."""
    generator = torch.Generator().manual_seed(100 * number + value)
    return Layer(torch.rand(64, 64, 3, generator=generator), torch.rand(64, 64, generator=generator))


def same(a: Layer, b: Layer) -> bool:
    return torch.equal(a.color, b.color) and torch.equal(a.transmittance, b.transmittance)


class StorageMachine(RuleBasedStateMachine):
    """A kill leaves what the kernel has of the files at that moment: what a copy of the folder holds."""

    def __init__(self):
        super().__init__()
        self.folder = Path(StorageMachine.base.mktemp("machine")) / "0"
        self.folder.mkdir()
        self.store = ParameterStore.create(self.folder / "store", {})
        self.cache = LayerCache(self.folder / "layers", CACHE_BYTES)
        self.content: dict[int, tuple[int, int]] = {}
        self.kills = 0

    def key(self, number: int) -> LayerKey:
        version = self.store.version(number)
        settings = {"sh_degree": 0, "raster_mode": "classic", "rasterizer": "torch-1", "bits": 16}
        crop = Crop(0, 0, 64, 64)
        return LayerKey(scene="s", view="v", crop=crop, content=((number, version),), **settings)

    def commit(self, blocks):
        updates = {number: block(rows, float(value)) for number, (rows, value) in blocks.items()}
        self.store.commit(updates, state={"content": sorted(blocks.items())})

    @rule(blocks=st.dictionaries(BLOCKS, CONTENT, min_size=1, max_size=3))
    def bump(self, blocks):
        self.commit(blocks)
        self.content |= blocks

    @rule(number=BLOCKS)
    def put(self, number):
        if number in self.content:
            self.cache.put(self.key(number), layer_of(number, self.content[number][1]))

    @rule()
    def evict(self):
        self.cache.clear()

    @rule()
    def reopen(self):
        self.store.close()
        self.cache.close()
        self.open()

    @rule(
        blocks=st.dictionaries(BLOCKS, CONTENT, min_size=1, max_size=2),
        number=BLOCKS,
        nth=st.integers(1, 16),
    )
    def be_killed(self, blocks, number, nth):
        """At the n-th point that a commit, and putting a layer after it, come to."""
        self.kills += 1
        copy, old, left = self.folder.with_name(str(self.kills)), self.store.generation, nth

        def reached(point: str) -> None:
            del point
            nonlocal left
            left -= 1
            if left == 0:
                shutil.copytree(self.folder, copy)

        before, crash_points.reached = crash_points.reached, reached
        try:
            self.commit(blocks)
            if number in blocks:
                self.cache.put(self.key(number), layer_of(number, blocks[number][1]))
        finally:
            crash_points.reached = before
        self.store.close()
        if copy.exists():
            self.cache.close()
            self.folder = copy
        self.open(cache=copy.exists())
        assert self.store.generation in (old, old + 1)
        if self.store.generation == old + 1:
            self.content |= blocks

    def open(self, cache: bool = True) -> None:
        self.store = ParameterStore.open(self.folder / "store")
        if cache:
            self.cache = LayerCache(self.folder / "layers", CACHE_BYTES)

    @invariant()
    def agree(self):
        assert self.store.blocks == sorted(self.content)
        for number, (rows, value) in self.content.items():
            assert_block(self.store, number, rows, float(value))
            found = self.cache.get(self.key(number))
            assert found is None or same(found, through_codec(layer_of(number, value), 16))
        assert self.cache.corrupt == self.cache.recreated == 0
        assert not list((self.folder / "store").glob(".*"))

    def teardown(self):
        self.store.close()
        self.cache.close()


def test_store_and_cache_are_dictionaries_whenever_they_are_killed(tmp_path_factory):
    StorageMachine.base = tmp_path_factory
    case = StorageMachine.TestCase
    case.settings = settings(max_examples=20, stateful_step_count=15, deadline=None, derandomize=True)
    case().runTest()
