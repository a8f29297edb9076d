"""Options outside training's own change a checkpoint too; see tests/engine/train/test_option_effects.py."""

from operator import attrgetter
from types import SimpleNamespace

import pytest
import torch

from abcd_ns.engine.gaussians.block_state import checksum
from abcd_ns.engine.types import Gaussians
from tests.nerfstudio.crash_training import gaussians
from tests.nerfstudio.test_training import configure, run

CHANGES = {
    "machine.seed": 7,
    "pipeline.partition": "grid",
    "pipeline.near_plane": 4.44,  # through the wall
    "pipeline.training.point_pixels": 20.0,
    "pipeline.model.random_init": True,
}


@pytest.fixture(scope="module")
def learnt(data, tmp_path_factory):
    """The checksum of the Gaussians in the checkpoint of a short run with one option changed."""

    def train(name: str | None = None, value: object = None) -> str:
        config = configure(data, tmp_path_factory.mktemp("out"), steps=6, blocks=2)
        config.pipeline.model.num_random = 300
        if name is not None:
            parent, _, last = f"config.{name}".rpartition(".")
            setattr(attrgetter(parent)(SimpleNamespace(config=config)), last, value)
        torch.manual_seed(config.machine.seed)  # as nerfstudio's train_loop
        scene = gaussians(run(config).base_dir)
        return checksum(Gaussians(**{name.rpartition(".")[2]: value for name, value in scene.items()}))

    return train


@pytest.fixture(scope="module")
def usual(learnt):
    return learnt()


@pytest.mark.parametrize("name", CHANGES)
def test_an_option_changes_the_checkpoint(name, learnt, usual):
    assert learnt(name, CHANGES[name]) != usual


def test_a_budget_of_ram_does_not(learnt, usual):
    assert learnt("pipeline.ram_budget_gb", 1 / 2**30) == usual
