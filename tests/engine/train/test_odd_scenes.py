"""Scenes that no capture should be, and some are: pictures of all sizes, a block that nobody can see."""

import math
from dataclasses import replace

import torch

from abcd_ns.engine.gaussians.initialize import cloud_from_points
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.health import unsound
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views, whole_scene

SIZES = ((1, 1), (7, 5), (33, 17), (101, 67), (48, 36), (16, 64))


def test_pictures_of_any_size_train_together(tmp_path):
    rings = [ring_of_views(len(SIZES), width=width, height=height) for width, height in SIZES]
    views = [ring[index] for index, ring in enumerate(rings)]
    photos = Photos(random_gaussians(60, seed=7, size=0.1), views)
    density = DensityConfig(refine_start=0.0)
    start = random_gaussians(60, seed=1, size=0.08)
    coordinator = make_coordinator(tmp_path, start, views, steps=24, density=density)
    while not coordinator.finished:
        train_step(coordinator, photos)
    assert not bool(unsound(whole_scene(coordinator)).any())


def test_a_block_inside_an_opaque_ball_is_visited_once_and_then_passed_over(tmp_path):
    draw = {"generator": torch.Generator().manual_seed(1)}
    shell = 0.5 * torch.nn.functional.normalize(torch.randn((900, 3), **draw), dim=1)
    wall = cloud_from_points(shell, torch.full((900, 3), 128.0), sh_degree=1).gaussians()
    wall = replace(
        wall, scales=torch.full_like(wall.scales, math.log(0.08)), opacities=torch.full((900, 1), 8.0)
    )
    inside = cloud_from_points(
        0.02 * torch.randn((30, 3), **draw), torch.full((30, 3), 255.0), sh_degree=1
    ).gaussians()
    tree, origin = build_kd(torch.zeros(0, 3), 1), torch.zeros(1, 3)
    for axis in range(3):
        for at in (-0.2, 0.2):
            tree = tree.split(int(tree.assign(origin)), axis, at)
    core, views = int(tree.assign(origin)), ring_of_views(6, width=24, height=18)
    options = {"tree": tree, "warmup": 0.0, "passes": 1, "density": DensityConfig(strategy="off")}
    coordinator = make_coordinator(tmp_path, Gaussians.cat([wall, inside]), views, steps=10_000, **options)
    photos = Photos(wall, views)
    while coordinator.state.epoch < 2:
        train_step(coordinator, photos)
    assert coordinator.state.health[core].hidden
    assert coordinator.scene.clocks(core).visits == 1
