"""The viewer's pictures: the whole scene by nodes, and what belongs to one block."""

import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.layers.compositing import over
from abcd_ns.engine.layers.layer_renderer import LayerRenderer, RenderSettings
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.viewer.pictures import FAR, MOST_PIXELS, BlockPictures, Show, bounded
from tests.reference.scenes import random_gaussians, ring_of_views

SETTINGS = RenderSettings(sh_degree=1)
DRAW = TorchRasterizer()
GAUSSIANS = random_gaussians(400, size=0.03, dtype=torch.float64)
VIEW = ring_of_views(3, dtype=torch.float64)[1]
TREE = build_kd(GAUSSIANS.means, 6)


def pictures(ownership="fragments", gaussians=GAUSSIANS):
    scene = MemoryScene(TREE, gaussians)
    return BlockPictures(LayerRenderer(scene, DRAW, ownership=ownership, pass_gaussians=0), VIEW, SETTINGS)


def test_a_block_alone_is_its_own_gaussians():
    owner = TREE.assign(GAUSSIANS.means)
    found = pictures().draw(Show.BLOCK, 2)
    expected = DRAW(GAUSSIANS[owner == 2], VIEW, sh_degree=1)
    assert torch.equal(found.color, expected.color)
    assert torch.equal(found.depth, expected.depth)


@pytest.mark.parametrize("block", [0, 3])
def test_by_fragments_the_composite_is_the_merged_picture(block):
    found = pictures().draw(Show.COMPOSITE, block)
    merged = DRAW(GAUSSIANS, VIEW, sh_degree=1)
    assert float((found.color - merged.color).abs().max()) < 2e-3


@pytest.mark.parametrize("ownership", ["fragments", "means"])
def test_by_either_ownership_front_and_back_are_what_the_composite_is_made_of(ownership):
    made = pictures(ownership)
    front, back = made.draw(Show.FRONT, 3), made.draw(Show.BACK, 3)
    whole = made.draw(Show.COMPOSITE, 3)
    assert float(front.transmittance.min()) < 0.9
    assert torch.allclose(front.depth, FAR * (1 - front.transmittance))  # far behind the boxes
    # F alone over B shows no more than the composite does.
    without = over(front.layer, back.layer)
    assert bool((without.transmittance >= whole.transmittance - 1e-9).all())
    if ownership == "means":
        alone = made.draw(Show.BLOCK, 3)
        expected = over(front.layer, over(alone.layer, back.layer))
        assert float((expected.color - whole.color).abs().max()) < 1e-12


def test_an_empty_block_shows_nothing():
    made = pictures(gaussians=GAUSSIANS[TREE.assign(GAUSSIANS.means) != 2])
    nothing = made.draw(Show.BLOCK, 2)
    assert float(nothing.transmittance.min()) == 1.0
    assert nothing.depth.shape == (VIEW.height, VIEW.width)
    assert torch.isfinite(made.draw(Show.COMPOSITE, 2).color).all()


def test_no_client_makes_a_picture_of_any_size():
    huge = bounded(replace(VIEW, width=100_000, height=50_000))
    assert huge.width * huge.height <= MOST_PIXELS
    assert huge.width == pytest.approx(2 * huge.height, rel=0.01)
    assert float(huge.K[0, 0]) == pytest.approx(float(VIEW.K[0, 0]) * huge.width / 100_000, rel=0.01)
    assert bounded(VIEW) == VIEW
    nothing = bounded(replace(VIEW, width=0))
    assert (nothing.width, nothing.height) == (1, VIEW.height)


DRAWS_TO_THE_END = """
import threading, torch
from nerfstudio.viewer.render_state_machine import RenderStateMachine
import abcd_ns.viewer.pictures

class Busy(RenderStateMachine):
    def __init__(self):
        threading.Thread.__init__(self, daemon=True)
        self.running, self.begun = True, threading.Event()

    def run(self):
        while self.running:
            torch.zeros(1).broadcast_to(4)
            self.begun.set()

for busy in [Busy() for _ in range(4)]:
    busy.start()
    busy.begun.wait()
"""


def test_a_process_that_still_draws_for_browsers_ends_in_order():
    run = subprocess.run(
        [sys.executable, "-c", DRAWS_TO_THE_END], capture_output=True, text=True, check=False
    )
    assert (run.returncode, run.stdout) == (0, ""), run.stderr
