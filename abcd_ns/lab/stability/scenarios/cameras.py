"""A10, A18, A20, A21: odd cameras, odd pictures, odd machines."""

import math
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from abcd_ns.engine.kernels import share_cores
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.self_check import self_check
from abcd_ns.engine.space.ordering import front_to_back
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.health.health_rules import unsound
from abcd_ns.lab.stability.lab import PAIR, Lab, make_stage
from abcd_ns.lab.stability.outcome import Finding, scenario
from abcd_ns.lab.stability.scenarios.blocks import equal
from abcd_ns.lab.world.world import TABLE, camera, ring
from abcd_ns.machine import threads_wanted

SIZES = ((1, 1), (7, 5), (33, 17), (101, 67), (48, 36), (16, 64))
RAYS = 300
SAMPLES = 80


def edge_cameras(tree) -> list[Tensor]:
    """Centres inside a cell, on a face, an edge and a corner, and a step of float64 to either side."""
    inner = (tree.axis >= 0).nonzero()[:, 0].tolist()
    planes = {
        axis: [float(tree.threshold[n]) for n in inner if int(tree.axis[n]) == axis] for axis in range(3)
    }
    centers = [torch.tensor([0.013, -0.021, 0.034], dtype=torch.float64)]
    choices = [[None, *planes[axis][:2]] for axis in range(3)]
    for place in product(*choices):
        for side in (0, -1, 1):
            at = [0.0123 * (axis + 1) if p is None else _beside(p, side) for axis, p in enumerate(place)]
            centers.append(torch.tensor(at, dtype=torch.float64))
    return centers


def _beside(value: float, side: int) -> float:
    return value if side == 0 else math.nextafter(value, side * math.inf)


def wrong_rays(tree, center: Tensor, seed: int) -> int:
    """Rays from `center` that meet cells in another order than the image's."""
    draw = {"generator": torch.Generator().manual_seed(seed), "dtype": torch.float64}
    directions = torch.randn((RAYS, 3), **draw)
    directions[::7, seed % 3] = 0.0  # along a plane
    along = torch.logspace(-9, 1, SAMPLES, dtype=torch.float64)
    places = center + along[None, :, None] * directions[:, None, :]
    cells = tree.assign(places.reshape(-1, 3)).reshape(RAYS, SAMPLES)
    rank = torch.empty(tree.num_blocks, dtype=torch.int64)
    rank[torch.tensor(front_to_back(tree, center))] = torch.arange(tree.num_blocks)
    return int((rank[cells].diff(dim=1) < 0).any(dim=1).sum())


@scenario(
    "A10",
    "blocks drawn in the wrong order near borders",
    "cameras in a block, on faces, edges and corners, and one step of float64 beside each",
    "0 rays that meet the blocks in another order than the image's",
)
def odd_places(lab: Lab) -> Finding:
    """A10: cameras in blocks, on faces, edges and corners, and one step of float64 beside them."""
    points = torch.randn((600, 3), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    tree = build_kd(points, 9 if lab.quick else 27)
    centers = edge_cameras(tree)
    wrong = sum(wrong_rays(tree, center, seed) for seed, center in enumerate(centers))
    said = {"abcd": f"{wrong} wrong of {RAYS * len(centers):,} rays from {len(centers)} cameras"}
    return Finding(wrong == 0, said, {"wrong": wrong, "rays": RAYS * len(centers)})


@scenario(
    "A18",
    "odd, tiny and mixed image sizes; distortion",
    "one run on 1 x 1, 7 x 5, 33 x 17, 101 x 67 and others; OPENCV lenses with k = 0 and with absurd k",
    "the run ends with finite values; k = 0 is left alone; an absurd k is an error that says so",
)
def odd_sizes(lab: Lab) -> Finding:
    """A18: pictures of 1 to 6,767 pixels in one run; lenses with no and with absurd distortion."""
    views = [camera_of(index, size) for index, size in enumerate(SIZES)]
    stage = make_stage(TABLE, views, ring(2, turn=0.5), points=200)
    trained = lab.train(stage, budget=lab.views_drawn(120), blocks=4, density=DensityConfig(refine_start=0.0))
    sound = trained.coordinator.finished and not bool(unsound(trained.gaussians).any())
    plain, refused = lenses()
    said = {"abcd": f"{len(SIZES)} sizes from 1 x 1 on: the run ended, values finite; "}
    said["abcd"] += f"k = 0 left alone: {plain}; absurd k refused: {refused}"
    return Finding(sound and plain and refused, said, {"psnr": trained.psnr})


def camera_of(index: int, size: tuple[int, int]):
    """Camera `index` of a ring of six, with a picture of another size."""
    angle = 2 * math.pi * index / 6
    return camera((math.cos(angle), math.sin(angle), 0.3), (0.0, 0.0, 0.0), index, size)


def lenses() -> tuple[bool, bool]:
    """Whether a lens with k = 0 is left as it is, and one with an absurd k refused by an error of ours."""
    from abcd_ns.data.scene import Lens  # loads nerfstudio
    from abcd_ns.data.undistort import undistortion
    from abcd_ns.errors import UserError

    plain = Lens(64, 48, 60.0, 60.0, 32.0, 24.0, distortion=(0.0, 0.0, 0.0, 0.0))
    try:
        undistortion(replace(plain, distortion=(-3.0, 0.0, 0.0, 0.0)))
    except UserError:
        return not plain.distorted, True
    return not plain.distorted, False


@scenario(
    "A20",
    "same seed, other result: 24.2 to 28.1 dB over 45 runs (Inria #89)",
    "one run twice on one thread, then on two and three",
    "all bit-equal, on a CPU",
    cost=4,
)
def repeated(lab: Lab) -> Finding:
    """A20: the same run twice, and with another number of threads."""
    stage, same = make_stage(views=ring(8), points=300), {}
    options = {"budget": lab.views_drawn(90), "blocks": 4, "density": DensityConfig(refine_start=0.0)}
    for method in PAIR:
        results = []
        try:
            for count in (1, 1, 2, 3):
                share_cores(count)
                results.append(lab.train(stage, method, **options).gaussians)
        finally:
            share_cores(threads_wanted())
        same[method] = [equal(results[0], other) for other in results[1:]]
    said = {m: f"again: {_yes(s[0])}; 2 and 3 threads: {_yes(all(s[1:]))}" for m, s in same.items()}
    numbers = {f"equal runs {method}": sum(found) for method, found in same.items()}
    return Finding(all(same["abcd"]), said, numbers)


def _yes(same: bool) -> str:
    return "bit-equal" if same else "not bit-equal"


class WrongGradient(TorchRasterizer):
    """Draws the right picture and gives rotations the opposite gradient."""

    name = "wrong gradient"

    def draw(self, gaussians, shots, **options):
        turned = 2 * gaussians.quats.detach() - gaussians.quats
        return super().draw(replace(gaussians, quats=turned), shots, **options)


@scenario(
    "A21",
    "picture right, gradient wrong: 14 dB instead of 25 (a ROCm port)",
    "the self-check at the start, of a backend whose rotations get the opposite gradient",
    "refused, and the wrong gradient named",
)
def wrong_gradient(lab: Lab) -> Finding:  # noqa: ARG001 - nothing is trained
    """A21: the check at the start, of a sound backend and of one with a wrong gradient."""
    sound = self_check(TorchRasterizer(use_native=False), "cpu")
    try:
        self_check(WrongGradient(use_native=False), "cpu")
    except RuntimeError as error:
        said = {"abcd": f'"{str(error).split(", so")[0]}"'}
        return Finding(sound == 0.0, said, {"difference of a sound one": sound})
    return Finding(False, {"abcd": "accepted"}, {"difference of a sound one": sound})
