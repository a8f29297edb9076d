"""An option that changes nothing is a fault: each changes what is learnt, but for those that say so."""

import pytest

from abcd_ns.engine.gaussians.block_state import checksum
from abcd_ns.engine.train import schedule
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.step import pose_rounds
from abcd_ns.engine.train.training_loop import train
from abcd_ns.errors import UserError
from tests.reference.scenes import make_coordinator, random_gaussians, training_config, whole_scene

GROWING = {"refine_start": 0.0, "refine_every": 5, "split_pixels": 1.0, "min_contribution": 2.0}
OTHERS = {
    "primitive": "2dgs",
    "sh_degree": 2,
    "background": "white",
    "light": "exposure",
    "poses": "SO3xR3",
    "antialiased": True,
    "warmup": 0.6,
    "coarse": 0.5,
    "batch": 3,
    "ssim_lambda": 0.6,
    "seed": 1,
}
OTHERS_OF_DENSITY = {
    "strategy": "off",
    "max_gaussians": 125,
    "min_contribution": 0.0,
    "split_pixels": 1e4,
    "refine_start": 0.3,
    "refine_stop": 0.1,
    "refine_every": 12,
    "cull_alpha_thresh": 0.3,
}
NOT_LEARNT = {"recipe", "limits", "density", "commit_seconds"}
"""What defines a method or follows from memory, the group tested beside, and when blocks are written."""


@pytest.fixture(scope="module")
def learnt(tmp_path_factory, views, photos):
    """The checksum of what a short run learns by these options."""

    def run(density=GROWING, sh_degree=1, **options) -> str:
        start = random_gaussians(120, seed=1, size=0.12, sh_degree=sh_degree)
        usual = {"blocks": 2, "steps": 24, "coarse_model": 60, "warmup": 0.3, "coarse": 0.2}
        if "poses" in options:
            usual["target"] = photos.target
        options = {**usual, "density": DensityConfig(**density), **options}
        coordinator = make_coordinator(tmp_path_factory.mktemp("run"), start, views, **options)
        train(coordinator, photos)
        scene = whole_scene(coordinator)
        coordinator.close()
        return checksum(scene)

    with pytest.MonkeyPatch.context() as patch:  # so that these small photos are reduced, and poses refined
        patch.setattr(schedule, "LEAST_SIDE", 1)
        patch.setattr(pose_rounds, "FIRST", 0.0)
        yield run


@pytest.fixture(scope="module")
def usual(learnt):
    return learnt()


def test_the_same_options_learn_the_same(learnt, usual):
    assert learnt(commit_seconds=0.0) == usual


@pytest.mark.parametrize("name", OTHERS)
def test_an_option_of_training_changes_what_is_learnt(name, learnt, usual):
    assert learnt(**{name: OTHERS[name]}) != usual


@pytest.mark.parametrize("name", OTHERS_OF_DENSITY)
def test_an_option_of_density_changes_what_is_learnt(name, learnt, usual):
    assert learnt({**GROWING, name: OTHERS_OF_DENSITY[name]}) != usual


@pytest.mark.parametrize(
    ("option", "others"),
    [
        ({"antialiased": True}, {"primitive": "2dgs"}),
        ({"poses": "SO3xR3"}, {"primitive": "2dgs"}),
        ({"poses": "SO3xR3"}, {"exact": True}),
        ({"poses": "SO3xR3"}, {"overlap": 0.1, "layers": False, "migrate": False}),
        ({"light": "affine"}, {"exact": True}),
    ],
)
def test_what_contradicts_a_method_or_its_primitive_is_refused(option, others):
    training_config(**option).check()
    with pytest.raises(UserError, match=f"training.{next(iter(option))} is for "):
        training_config(**option, **others).check()
