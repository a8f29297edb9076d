"""A11, A12, A16: too few views, poses and exposures that are off, a far background."""

import math
from dataclasses import replace

import torch
from scipy.spatial.transform import Rotation

from abcd_ns.engine.gaussians.initialize import random_points
from abcd_ns.engine.types import View
from abcd_ns.lab.stability.lab import METHODS, PAIR, Finding, Lab, Stage, make_stage, scenario
from abcd_ns.lab.world.world import TABLE, Ball, Surfaces

FEW = 3
TURN_DEGREES, SHIFT = 0.5, 0.01
"""Of noisy poses: standard deviations; the shift in distances of the cameras."""
GAIN = 1.5
FAR = 50.0
MARGIN = 0.3
"""dB that a fault may cost ABCD more than one block."""


def with_noisy_poses(stage: Stage) -> Stage:
    """The same photos, under poses that are off, turned about random axes; those held out are right."""
    draw = {"generator": torch.Generator().manual_seed(0), "dtype": torch.float64}

    def move(view: View) -> View:
        axis = torch.nn.functional.normalize(torch.randn(3, **draw), dim=0)
        angle = math.radians(TURN_DEGREES) * float(torch.randn((), generator=draw["generator"]))
        matrix = view.viewmat.double().clone()
        matrix[:3] = torch.from_numpy(Rotation.from_rotvec(angle * axis.numpy()).as_matrix()) @ matrix[:3]
        matrix[:3, 3] += SHIFT * torch.randn(3, **draw)
        return replace(view, viewmat=matrix.float())

    return replace(stage, views=[move(view) for view in stage.views])


def with_gains(stage: Stage) -> Stage:
    """Every other photo brighter, as a camera that chooses its exposure leaves them; clipped at white."""
    photos = {
        i: (photo * (GAIN if k % 2 else 1)).clamp(0, 1) for k, (i, photo) in enumerate(stage.photos.items())
    }
    return replace(stage, photos=photos)


def lost(lab: Lab, cases: dict[str, Stage]) -> Finding:
    """What each fault costs each method, against the same method without it: ABCD no more than one block.

    What blocks cost without any fault is another question, see A19.
    """
    clean = {method: lab.compared(make_stage(), method, "table") for method in METHODS}
    numbers = {f"clean {method}": value for method, value in clean.items()}
    said = {method: f"{value:.2f} dB without" for method, value in clean.items()}
    passed, worse = True, False
    for name, stage in cases.items():
        found = {method: lab.compared(stage, method) for method in PAIR}
        for method, value in found.items():
            said[method] += f", {value:.2f} ({value - clean[method]:+.2f}) with {name}"
            numbers[f"{name} {method}"] = value
        costs = {method: clean[method] - found[method] for method in PAIR}
        passed &= costs["abcd"] <= costs["abcd-monolithic"] + MARGIN
        worse |= found["abcd"] < found["abcd-monolithic"]
    return Finding(passed, said, numbers, worse)


@scenario(
    "A11",
    "sparse, unbalanced views; a random start costs 4 to 5 dB (RAIN-GS)",
    f"{FEW} of 16 cameras; points at random places",
    "PSNR falls by no more than one block's does, and 0.3 dB",
)
def sparse(lab: Lab) -> Finding:
    """A11: few views; a random start."""
    stage = make_stage()
    points, colors = random_points(len(stage.points), 1.2)  # without a reconstruction
    random = replace(stage, points=points, colors=colors)
    return lost(lab, {f"{FEW} views": stage.only(FEW), "a random start": random})


@scenario(
    "A12",
    "noisy poses, changing exposure (H3DGS #55, VastGaussian)",
    f"poses off by {TURN_DEGREES} degrees and {SHIFT:.0%}; every other photo {GAIN} times as bright",
    "PSNR falls by no more than one block's does, and 0.3 dB",
)
def inexact(lab: Lab) -> Finding:
    """A12: poses that are off, exposures that differ."""
    stage = make_stage()
    return lost(lab, {"noisy poses": with_noisy_poses(stage), "two exposures": with_gains(stage)})


@scenario(
    "A16",
    "sky and far background lost (H3DGS #39, Inria #300)",
    f"a textured shell {FAR:g} times as far away as the cameras stand",
    "PSNR falls by no more than one block's does, and 0.3 dB",
)
def far_shell(lab: Lab) -> Finding:
    """A16: half of each picture is a shell 50 times as far away as the cameras stand."""
    world = Surfaces((*TABLE.surfaces[:-1], Ball((0.0, 0.0, 0.0), FAR)))
    return lost(lab, {"a far shell": make_stage(world)})
