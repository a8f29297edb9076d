"""The store gives back what was committed, pinned and cloned: it is a dictionary with generations."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from abcd_ns.engine.store import ParameterStore, StoreError, atomic, crash_points, shard
from tests.reference.store_helpers import FailAt, assert_block, block, names_in

DTYPES = (torch.float32, torch.float64, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool)


def test_what_was_committed_is_there_after_reopening(store):
    state = {"pair": (1, 2), "by block": {4: "x"}}
    blocks = {7: block(2, 9.0), "inbox": block(1, 4.0), 10: block(0)}
    store.commit(blocks, header={"tree": "new"}, state=state)
    store.state["pair"].append(3)  # of a copy
    store.close()
    with ParameterStore.open(store.folder) as again:
        assert (again.generation, again.blocks) == (2, [0, 7, 10, "inbox"])
        assert again.state == store.state == {"pair": [1, 2], "by block": {"4": "x"}}
        assert again.header == {"tree": "new"}
        assert_block(again, 0, 3, 1.0)
        assert_block(again, "inbox", 1, 4.0)


@given(st.data())
@settings(max_examples=12)
def test_any_tensor_survives(tmp_path_factory, data):
    tensors = {}
    for name in data.draw(st.lists(st.text("abcdef._é", min_size=1, max_size=8), max_size=4, unique=True)):
        shape = data.draw(st.lists(st.integers(0, 3), max_size=4))
        count = int(np.prod(shape))
        tensors[name] = torch.arange(count).reshape(shape).to(data.draw(st.sampled_from(DTYPES)))
    meta = data.draw(st.dictionaries(st.text(max_size=5), st.none() | st.floats(allow_nan=False) | st.text()))
    with ParameterStore.create(tmp_path_factory.mktemp("any") / "s", {}) as store:
        store.commit({3: (tensors, meta)})
        back, back_meta = store.load(3)
        assert back_meta == meta
        assert back.keys() == tensors.keys()
        for name, tensor in tensors.items():
            assert (back[name].dtype, back[name].shape) == (tensor.dtype, tensor.shape)
            assert torch.equal(back[name], tensor)


def test_views_shared_tensors_and_autograd_are_written_by_value(store):
    base = torch.arange(12.0).reshape(3, 4).requires_grad_()
    given = {"a": base, "b": base, "turned": base.T, "row": base[1:2]}
    store.commit({1: (given, {})})
    tensors, _ = store.load(1)
    assert all(torch.equal(tensors[name], value.detach()) for name, value in given.items())
    tensors["a"].zero_()
    assert torch.equal(store.load(1)[0]["a"], base.detach())


def test_some_tensors_can_be_loaded_alone(store):
    tensors, _ = store.load(0, ["means"])
    assert tensors.keys() == {"means"}
    assert torch.equal(tensors["means"], block(3, 1.0)[0]["means"])
    with pytest.raises(StoreError, match="does not contain tensor moments"):
        store.load(0, ["moments"])
    with pytest.raises(KeyError, match="no block 5"):
        store.load(5)


def test_bad_updates_are_refused_and_change_nothing(store):
    before = names_in(store.folder)
    with pytest.raises(TypeError):
        store.commit({0: block(1), 1: ({}, {"x": object()})})
    assert store.generation == 1
    assert names_in(store.folder) == before


# Pins and clones


def test_a_pinned_generation_is_for_reading_until_it_is_removed(store):
    store.pin("best")
    store.commit({0: block(4, 5.0)}, state={"clock": 6})
    pinned = ParameterStore.open(store.folder, "best")
    assert (pinned.generation, pinned.state, store.pins) == (1, {"clock": 5}, ["best"])
    with pytest.raises(StoreError, match="open for reading"):
        pinned.commit({})
    store.unpin("best")
    with pytest.raises(StoreError, match="best"):
        store.unpin("best")


def test_a_damaged_pin_stops_the_collection_and_not_the_training(store):
    store.pin("best")
    pin = store.folder / "manifest-best.json"
    pin.write_bytes(pin.read_bytes()[:-1])
    with pytest.warns(UserWarning, match="best"):
        store.commit({0: block(4, 5.0)})
    assert len(list(store.folder.glob("*.safetensors"))) == 3
    store.unpin("best")
    assert len(list(store.folder.glob("*.safetensors"))) == 2


@pytest.mark.parametrize("name", ["", "a/b", "../x", "a b"])
def test_a_pin_cannot_leave_the_folder(store, name):
    with pytest.raises(ValueError, match="name"):
        store.pin(name)


@pytest.mark.parametrize("links", [True, False])
def test_a_clone_is_a_store_of_its_own(store, tmp_path, monkeypatch, links):
    if not links:
        monkeypatch.setattr(shard.os, "link", FailAt(os.link, 1, persistent=True))
    store.pin("start")
    store.commit({0: block(4, 5.0)})
    store.clone_to(tmp_path / "now")
    store.clone_to(tmp_path / "then", "start")
    with ParameterStore.open(tmp_path / "now") as clone:
        assert (clone.generation, clone.header, clone.pins) == (2, store.header, [])
        file = next(clone.folder.glob("block-000000-*"))
        assert (file.stat().st_nlink > 1) is links
        clone.commit({0: block(1, 6.0)})
        assert_block(store, 0, 4, 5.0)
    with ParameterStore.open(tmp_path / "then") as clone:
        assert_block(clone, 0, 3, 1.0)
    with pytest.raises(StoreError, match="already holds a store"):
        store.clone_to(tmp_path / "then")


def test_a_failed_clone_is_no_store(store, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "replace", FailAt(os.replace, 1))
        with pytest.raises(StoreError, match="could not be cloned"):
            store.clone_to(tmp_path / "clone")
    assert names_in(tmp_path / "clone") == {"lock"}
    store.clone_to(tmp_path / "clone")
    assert_block(ParameterStore.open(tmp_path / "clone", read_only=True), 0, 3, 1.0)


class StoreMachine(RuleBasedStateMachine):
    """The store against a dictionary, through commits, failures, kills, pins and reopening.

    A kill leaves what the kernel has of the files at that moment: what a copy of the folder holds.
    """

    blocks_ = st.dictionaries(st.integers(0, 4), st.tuples(st.integers(0, 3), st.integers(0, 99)), max_size=3)
    names = st.sampled_from(["a", "b"])

    def __init__(self):
        super().__init__()
        self.folder = Path(StoreMachine.base.mktemp("machine")) / "s"
        self.store = ParameterStore.create(self.folder, {})
        self.model: dict = {}
        self.pins: dict = {}
        self.generation = self.kills = 0

    def update(self, blocks):
        return {number: block(rows, float(value)) for number, (rows, value) in blocks.items()}

    @rule(blocks=blocks_)
    def commit(self, blocks):
        self.generation += 1
        assert self.store.commit(self.update(blocks), state={"n": self.generation}) == self.generation
        self.model |= {number: (*what, self.generation) for number, what in blocks.items()}

    @rule(blocks=blocks_, n=st.integers(1, 4))
    def fail(self, blocks, n):
        fsync = os.fsync
        atomic.os.fsync = FailAt(fsync, min(n, len(blocks) + 3))
        try:
            with pytest.raises(StoreError):
                self.store.commit(self.update(blocks))
        finally:
            atomic.os.fsync = fsync

    @rule(blocks=blocks_, nth=st.integers(1, 16))
    def be_killed(self, blocks, nth):
        """At the n-th point that a commit comes to."""
        self.kills += 1
        copy, old, left = self.folder.with_name(f"s{self.kills}"), self.generation, nth

        def reached(point: str) -> None:
            del point
            nonlocal left
            left -= 1
            if left == 0:
                shutil.copytree(self.folder, copy)

        before, crash_points.reached = crash_points.reached, reached
        try:
            self.store.commit(self.update(blocks), state={"n": self.generation + 1})
        finally:
            crash_points.reached = before
        self.store.close()
        self.folder = copy if copy.exists() else self.folder
        self.store = ParameterStore.open(self.folder)
        self.generation = self.store.generation
        assert self.generation in (old, old + 1)
        if self.generation > old:
            self.model |= {number: (*what, self.generation) for number, what in blocks.items()}

    @rule(name=names)
    def pin(self, name):
        self.store.pin(name)
        self.pins[name] = dict(self.model)

    @precondition(lambda self: self.pins)
    @rule(data=st.data())
    def restore(self, data):
        name = data.draw(st.sampled_from(sorted(self.pins)))
        self.generation += 1
        assert self.store.restore(name) == self.generation
        self.model = dict(self.pins[name])

    @precondition(lambda self: self.pins)
    @rule(data=st.data())
    def unpin(self, data):
        name = data.draw(st.sampled_from(sorted(self.pins)))
        self.store.unpin(name)
        del self.pins[name]

    @rule()
    def reopen(self):
        self.store.close()
        self.store = ParameterStore.open(self.folder)

    @invariant()
    def agree(self):
        views = [(self.store, self.model)]
        views += [(ParameterStore.open(self.folder, name), model) for name, model in self.pins.items()]
        files = {"lock", "manifest.json"} | {f"manifest-{name}.json" for name in self.pins}
        for view, model in views:
            assert view.blocks == sorted(model)
            for number, (rows, value, version) in model.items():
                assert_block(view, number, rows, float(value))
                files.add(f"block-{number:06d}-{version:08d}.safetensors")
        assert names_in(self.folder) == files
        assert self.store.generation == self.generation

    def teardown(self):
        self.store.close()


def test_the_store_is_a_dictionary(tmp_path_factory):
    StoreMachine.base = tmp_path_factory
    case = StoreMachine.TestCase
    case.settings = settings(max_examples=20, stateful_step_count=20)
    case().runTest()
