"""Blocks that are held on a device are the scene's, and read as seldom as there is room."""

from collections import Counter

import pytest
import torch

from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.derived_scenes import HeldScene
from abcd_ns.engine.store.scene import MemoryScene
from tests.reference.scenes import random_gaussians


@pytest.mark.parametrize(("blocks_held", "reads"), [(0, [2, 2, 2, 2]), (2, [1, 1, 2, 2]), (4, [1, 1, 1, 1])])
def test_blocks_are_held_while_there_is_room(blocks_held, reads, monkeypatch):
    gaussians = random_gaussians(64)
    scene = MemoryScene(build_kd(gaussians.means, 4), gaussians)
    largest = max(scene.gaussians(block).nbytes for block in range(4))
    held = HeldScene(scene, torch.device("cpu"), blocks_held * largest)
    read, drawn = Counter(), scene.drawn
    monkeypatch.setattr(scene, "drawn", lambda block, device: (read.update([block]), drawn(block, device))[1])
    for _ in range(2):
        for block in range(4):
            for name, value in held.gaussians(block).items():
                assert torch.equal(value, getattr(scene.gaussians(block), name))
    assert [read[block] for block in range(4)] == reads
