"""The ways to fail: too few views, poses and exposures that are off, old layers, seams, a far shell, fog."""

import math
from dataclasses import replace
from functools import partial
from itertools import pairwise
from statistics import mean

import torch
import torch.nn.functional as F
from jaxtyping import Bool
from scipy.spatial.transform import Rotation
from torch import Tensor

from abcd_ns.engine.events import Event, VisitEnded
from abcd_ns.engine.gaussians.initialize import random_points
from abcd_ns.engine.layers.surface import fog_in_white
from abcd_ns.engine.space.partition import build_grid
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.lab.stability.lab import BUDGET, METHODS, PAIR, Finding, Lab, Scenario, Stage, make_stage
from abcd_ns.lab.world.world import TABLE, Ball, Surfaces, Wall, World, camera, ring

FEW = 3
TURN_DEGREES, SHIFT = 0.5, 0.01  # of noisy poses: standard deviations; the shift in distances of the cameras
GAIN = 1.5
FAR = 50.0
MARGIN = 0.3  # dB that a fault may cost ABCD more than one block


def with_noisy_poses(stage: Stage) -> Stage:
    """The same photos, under poses that are off, turned about random axes; those held out are right."""
    draw = {"generator": torch.Generator().manual_seed(0), "dtype": torch.float64}

    def move(view: View) -> View:
        axis = F.normalize(torch.randn(3, **draw), dim=0)
        angle = math.radians(TURN_DEGREES) * float(torch.randn((), generator=draw["generator"]))
        matrix = view.viewmat.double().clone()
        matrix[:3] = torch.from_numpy(Rotation.from_rotvec(angle * axis.numpy()).as_matrix()) @ matrix[:3]
        matrix[:3, 3] += SHIFT * torch.randn(3, **draw)
        return replace(view, viewmat=matrix.float())

    return replace(stage, views=[move(view) for view in stage.views])


def lost(lab: Lab, cases: dict[str, Stage]) -> Finding:
    """What each fault costs each method, against the same method without it: ABCD no more than one block.

    What blocks cost without any fault is another question, see A19.
    """
    clean = {method: lab.score_of_table(method) for method in METHODS}
    numbers = {f"clean {method}": value for method, value in clean.items()}
    said = {method: f"{value:.2f} dB without" for method, value in clean.items()}
    passed, worse = True, False
    for name, stage in cases.items():
        found = {method: lab.train(stage, method).psnr for method in PAIR}
        for method, value in found.items():
            said[method] += f", {value:.2f} ({value - clean[method]:+.2f}) with {name}"
            numbers[f"{name} {method}"] = value
        costs = {method: clean[method] - found[method] for method in PAIR}
        passed &= costs["abcd"] <= costs["abcd-monolithic"] + MARGIN
        worse |= found["abcd"] < found["abcd-monolithic"]
    return Finding(passed, said, numbers, worse)


@partial(
    Scenario,
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


@partial(
    Scenario,
    "A12",
    "noisy poses, changing exposure (H3DGS #55, VastGaussian)",
    f"poses off by {TURN_DEGREES} degrees and {SHIFT:.0%}; every other photo {GAIN} times as bright",
    "PSNR falls by no more than one block's does, and 0.3 dB",
)
def inexact(lab: Lab) -> Finding:
    """A12: poses that are off, exposures that differ."""
    stage, photos = make_stage(), {}
    for k, (index, photo) in enumerate(stage.photos.items()):  # as a camera that chooses its exposure
        photos[index] = (photo * (GAIN if k % 2 else 1)).clamp(0, 1)
    return lost(lab, {"noisy poses": with_noisy_poses(stage), "two exposures": replace(stage, photos=photos)})


VISITS_RISING = 0.05
RISES_BY = 1e-3  # a visit raised the objective if by more than this share of it


@partial(
    Scenario,
    "A13",
    "old layers oscillate and diverge",
    "layers drawn anew for each visit, without a warm-up; the full objective after each",
    f"it rises in at most {VISITS_RISING:.0%} of visits",
)
def old_layers(lab: Lab) -> Finding:
    """A13: the objective after each visit."""
    stage = make_stage(views=ring(12))
    usual = {"budget": BUDGET // 2, "warmup": 0.0, "recipe": Recipe(limit_scales=False, passes=2)}
    usual["density"] = DensityConfig(strategy="off")
    coordinator = lab.coordinator(stage, **usual)
    errors = [full_error(lab, stage, coordinator.scene.everything("cpu"))]

    def listen(event: Event) -> None:
        if isinstance(event, VisitEnded):
            errors.append(full_error(lab, stage, coordinator.scene.everything("cpu")))

    coordinator.announce.subscribe(listen)
    while not coordinator.finished:
        train_step(coordinator, stage)
    rising = mean(after > (1 + RISES_BY) * before for before, after in pairwise(errors))
    score = lab.score(coordinator.scene.everything("cpu"), stage)
    said = {"abcd": f"{rising:.0%} of visits raised the objective, {score:.2f} dB"}
    return Finding(rising <= VISITS_RISING, said, {"rising": rising, "psnr": score})


def full_error(lab: Lab, stage: Stage, gaussians: Gaussians) -> float:
    """The full objective, near enough: the mean absolute error over all training photos."""
    drawn = lab.pictures(gaussians, stage.views)
    return mean(
        float((a - stage.photos[v.index]).abs().mean()) for a, v in zip(drawn, stage.views, strict=True)
    )


BAND = 4  # pixels to either side of a border
SEAM = 1.2  # the error in the band, in errors of the interior, at most
FLOOR = Surfaces((Wall(2, 0.0, 0.8, 0.8),))


def border_band(world: World, tree: BlockTree, view: View) -> Bool[Tensor, "h w"]:
    """Pixels near which the surface passes from one block to another."""
    places, _, _ = world.first(view)
    blocks = tree.assign(places).reshape(view.height, view.width)
    edge = torch.zeros(view.height, view.width)
    edge[:, 1:] += (blocks[:, 1:] != blocks[:, :-1]).float()
    edge[1:] += (blocks[1:] != blocks[:-1]).float()
    return F.max_pool2d(edge[None], 2 * BAND + 1, stride=1, padding=BAND)[0] > 0


def above(count: int, turn: float = 0.0) -> list[View]:
    """Cameras over the floor, in rows, looking down at a slant."""
    views = []
    for k in range(count):
        x, y = ((k % 4) - 1.5) * 0.22 + 0.05 * turn, ((k // 4) - 1.5) * 0.22 + 0.03 * turn
        views.append(camera((x, y - 0.25, 0.9), (x, y + 0.02, 0.0), k, (64, 48)))
    return views


@partial(
    Scenario,
    "A14",
    'seams, "chunk bleeding" and "ghosting" at borders (LoD of Gaussians, VastGaussian #49)',
    "a textured floor over four blocks, seen by held-out cameras",
    f"the error within {BAND} px of a border is at most {SEAM} times the interior's",
)
def seams(lab: Lab) -> Finding:
    """A14: a textured floor over four blocks."""
    held_out = above(16, turn=1.0)[::3]
    stage = make_stage(FLOOR, above(16), held_out, points=700)
    tree = build_grid(stage.points.float(), counts=(2, 2, 1))  # as the runs' partition cuts it
    inside = torch.stack([border_band(FLOOR, tree, view) for view in held_out])
    numbers, said = {}, {}
    for method in METHODS:
        trained = lab.train(stage, method, partition="grid")
        drawn = lab.pictures(trained.gaussians, held_out)
        errors = torch.stack([(a - b).abs().mean(dim=-1) for a, b in zip(drawn, stage.truth, strict=True)])
        ratio = float(errors[inside].mean() / errors[~inside].mean())
        numbers |= {f"ratio {method}": ratio, f"psnr {method}": trained.psnr}
        said[method] = f"{ratio:.2f} of the interior's error at borders, {trained.psnr:.2f} dB"
    against = numbers["ratio abcd"] / numbers["ratio abcd-monolithic"]
    said["abcd"] += f", {against:.2f} times one block's ratio"
    numbers["against one block"] = against
    return Finding(numbers["ratio abcd"] <= SEAM, said, numbers, worse=against > 1)


@partial(
    Scenario,
    "A16",
    "sky and far background lost (H3DGS #39, Inria #300)",
    f"a textured shell {FAR:g} times as far away as the cameras stand",
    "PSNR falls by no more than one block's does, and 0.3 dB",
)
def far_shell(lab: Lab) -> Finding:
    """A16: half of each picture is a shell 50 times as far away as the cameras stand."""
    world = Surfaces((*TABLE.surfaces[:-1], Ball((0.0, 0.0, 0.0), FAR)))
    return lost(lab, {"a far shell": make_stage(world)})


CLIFF_DB = 0.5
COUNTS = (1, 2, 4, 8, 27)


@partial(
    Scenario,
    "A19",
    "the number of blocks decides the quality",
    f"{', '.join(map(str, COUNTS))} blocks and a grid of 4, on a budget of 600 views",
    f"worst within {CLIFF_DB} dB of the best",
)
def blocks_and_cuts(lab: Lab) -> Finding:
    """A19: the defaults with 1 to 27 blocks, and with 4 of a grid, whose planes cut balls."""
    stage = make_stage()
    psnrs = {"1 block": lab.score_of_table("abcd-monolithic")}
    psnrs |= {f"{k} blocks": lab.train(stage, "abcd", blocks=k).psnr for k in COUNTS if k > 1}
    psnrs["4 of a grid"] = lab.train(stage, "abcd", partition="grid").psnr
    gap = max(psnrs.values()) - min(psnrs.values())
    behind = psnrs["1 block"] - min(psnrs.values())
    said = {"abcd": ", ".join(f"{name} {value:.2f}" for name, value in psnrs.items()) + " dB"}
    said["abcd-monolithic"] = f"{psnrs['1 block']:.2f} dB"
    numbers = {**{f"psnr {name}": value for name, value in psnrs.items()}, "best to worst": gap}
    return Finding(gap <= CLIFF_DB, said, numbers, worse=behind > 0)


FOG = 0.02  # of the screen, in the mean over training views, at most


@partial(
    Scenario,
    "A23",
    "fog before the cameras imitates each photo's vignette (drone captures)",
    "photos that darken by half towards their corners",
    f"Gaussians before the nearest point of a view take under {FOG:.0%} of the screen at any time",
)
def fog(lab: Lab) -> Finding:
    """A23: the share of the screen that fog takes, every 50 steps."""
    stage, said, most = make_stage(views=ring(12)), {}, {}
    dark = {index: photo * vignette(*photo.shape[:2]) for index, photo in stage.photos.items()}
    for method in PAIR:
        coordinator = lab.coordinator(stage, method)
        shares = [0.0]
        while not coordinator.finished:
            train_step(coordinator, replace(stage, photos=dark))
            if coordinator.state.step % 50 == 0:
                shares.append(share_of_fog(lab, coordinator.scene.everything("cpu"), stage.views))
        most[method] = max(shares)
        said[method] = f"{most[method]:.1%} of the screen at most"
    return Finding(max(most.values()) < FOG, said, {f"fog {name}": value for name, value in most.items()})


def vignette(height: int, width: int) -> Tensor:
    """1 in the middle, a half in the corners; [height, width, 1]."""
    y, x = torch.linspace(-1, 1, height)[:, None], torch.linspace(-1, 1, width)
    return (1 - (x.square() + y.square()) / 4)[..., None]


@torch.no_grad()
def share_of_fog(lab: Lab, gaussians: Gaussians, views: list[View]) -> float:
    """The mean over views."""
    white = (lab.rasterizer(fog_in_white(gaussians, view), view, sh_degree=0) for view in views)
    return mean(float(raster.color.mean()) for raster in white)
