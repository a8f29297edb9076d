"""The store is a dictionary: commits, kills and reopening in any order."""

import shutil
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from abcd_ns.engine.store import ParameterStore, crash_points
from tests.reference.store_helpers import assert_block, block

BLOCKS = st.integers(0, 3)
CONTENT = st.tuples(st.integers(1, 3), st.integers(0, 99))


class StorageMachine(RuleBasedStateMachine):
    """A kill leaves what the kernel has of the files at that moment: what a copy of the folder holds."""

    def __init__(self):
        super().__init__()
        self.folder = Path(StorageMachine.base.mktemp("machine")) / "0"
        self.folder.mkdir()
        self.store = ParameterStore.create(self.folder / "store", {})
        self.content: dict[int, tuple[int, int]] = {}
        self.kills = 0

    def commit(self, blocks):
        updates = {number: block(rows, float(value)) for number, (rows, value) in blocks.items()}
        self.store.commit(updates, state={"content": sorted(blocks.items())})

    @rule(blocks=st.dictionaries(BLOCKS, CONTENT, min_size=1, max_size=3))
    def bump(self, blocks):
        self.commit(blocks)
        self.content |= blocks

    @rule()
    def reopen(self):
        self.store.close()
        self.open()

    @rule(blocks=st.dictionaries(BLOCKS, CONTENT, min_size=1, max_size=2), nth=st.integers(1, 16))
    def be_killed(self, blocks, nth):
        """At the n-th point that a commit comes to."""
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
        finally:
            crash_points.reached = before
        self.store.close()
        if copy.exists():
            self.folder = copy
        self.open()
        assert self.store.generation in (old, old + 1)
        if self.store.generation == old + 1:
            self.content |= blocks

    def open(self) -> None:
        self.store = ParameterStore.open(self.folder / "store")

    @invariant()
    def agree(self):
        assert self.store.blocks == sorted(self.content)
        for number, (rows, value) in self.content.items():
            assert_block(self.store, number, rows, float(value))
        assert not list((self.folder / "store").glob(".*"))

    def teardown(self):
        self.store.close()


def test_the_store_is_a_dictionary_whenever_it_is_killed(tmp_path_factory):
    StorageMachine.base = tmp_path_factory
    case = StorageMachine.TestCase
    case.settings = settings(max_examples=20, stateful_step_count=15, deadline=None, derandomize=True)
    case().runTest()
