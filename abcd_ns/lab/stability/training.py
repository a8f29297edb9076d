"""A3, A5 to A7, A13, A14, A19, A23: oversized Gaussians, growth, old layers, seams, blocks, fog."""

import math
from dataclasses import replace
from itertools import pairwise
from statistics import mean

import torch
import torch.nn.functional as F
from jaxtyping import Bool
from torch import Tensor

from abcd_ns.engine.events import Event, StepTaken, VisitEnded
from abcd_ns.engine.layers.surface import fog_in_white
from abcd_ns.engine.space.partition import build_grid, build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.clock import DensityClock
from abcd_ns.engine.train.density.control import LEAST_REFINEMENTS, DensityConfig, DensityControl
from abcd_ns.engine.train.health.health_rules import OVERSIZED_ANGLE
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.lab.stability.lab import (
    BLOCKS,
    BUDGET,
    METHODS,
    PAIR,
    Finding,
    Lab,
    Stage,
    make_stage,
    merged,
    scenario,
)
from abcd_ns.lab.world.world import Surfaces, Wall, World, camera, ring

SIGMAS = (1.0, 3.0, 10.0)
"""Of the oversized Gaussians that are put in, in extents of their cell."""


def with_oversized(start: Gaussians, tree: BlockTree) -> Gaussians:
    """`start` with the Gaussian amid each of the first blocks so many extents wide."""
    owner, scales, opacities = tree.assign(start.means), start.scales.clone(), start.opacities.clone()
    for block, sigma in enumerate(SIGMAS):
        rows = (owner == block).nonzero()[:, 0]
        ranked, last = start.means[rows].sort(dim=0).values, len(rows) - 1
        middle = start.means[rows].median(dim=0).values
        widest = rows[(start.means[rows] - middle).norm(dim=1).argmin()]
        extent = (ranked[round(0.99 * last)] - ranked[round(0.01 * last)]).max()
        scales[widest], opacities[widest] = math.log(sigma * float(extent)), 0.0
    return replace(start, scales=scales, opacities=opacities)


def largest_share(gaussians: Gaussians, views: list[View]) -> float:
    """The largest standard deviation, as a share of what a Gaussian of its distance may have."""
    nearest = torch.cdist(gaussians.means, torch.stack([view.center for view in views])).amin(dim=1)
    return float((gaussians.scales.amax(dim=1).exp() / (OVERSIZED_ANGLE * nearest)).max())


@scenario(
    "A3",
    "needles and oversized Gaussians: half of garden's splats, the worst 3857 frames wide (brush #479)",
    "Gaussians with sigma = 1, 3 and 10 extents of their cell among the first ones",
    "shrunk by a block's refinements, none over 1.25 of what is allowed",
)
def oversized(lab: Lab) -> Finding:
    """A3: three oversized Gaussians at the start; two epochs, so that each block is refined once."""
    stage = make_stage(views=ring(12), points=400)
    tree = build_kd(stage.start().means, BLOCKS)
    start = with_oversized(stage.start(), tree)
    before, said = largest_share(start, stage.views), {}
    numbers = {"largest before": before}
    usual = {"start": start, "budget": 320}
    usual["density"] = DensityConfig(refine_start=0.0, refine_stop=1.0)
    for method, options in (("abcd", {"tree": tree, "warmup": 0.0}), ("abcd-monolithic", {})):
        after = largest_share(lab.train(stage, method, **usual, **options).gaussians, stage.views)
        numbers[f"largest {method}"] = after
        said[method] = f"largest {before:.1f} -> {after:.2f} of what is allowed"
    return Finding(numbers["largest abcd"] < 1.25, said, numbers)


CAP = 300


@scenario(
    "A5",
    "densification blows up; the cap is ignored at the start (desplat #5, gsplat #516)",
    "photos of noise, growth at the least gradient, twice as many points as the cap",
    "never over the cap, at any step",
)
def noise(lab: Lab) -> Finding:
    """A5: photos of noise, from twice as many points as there may be Gaussians."""
    stage, said, numbers, passed = make_stage(views=ring(12), points=2 * CAP), {}, {}, True
    draw = {"generator": torch.Generator().manual_seed(5)}
    photos = {index: torch.rand(photo.shape, **draw) for index, photo in stage.photos.items()}
    density = DensityConfig(max_gaussians=CAP, refine_start=0.0, refine_stop=1.0, split_pixels=0.0)
    for method in PAIR:
        options = {"budget": 300, "density": density}
        trained = lab.train(replace(stage, photos=photos), method, **options)
        most = max(trained.counts)
        numbers[f"most {method}"] = most
        said[method] = f"never over {most} of {CAP}"
        passed &= most <= CAP and trained.coordinator.finished
    return Finding(passed, said, numbers)


REFINE_EVERY = 25
"""Views: a few refinements in the warm-up and in each visit."""
FAINT = 0.01
"""Splatfacto's opacity after a reset."""
ALLOWED_RISE = 0.02
"""Of the mean absolute error over all training photos, by one visit."""


@scenario(
    "A6",
    "an opacity reset costs 2.7 to 7.6 dB (gsplat #1012)",
    f"a refinement after every {REFINE_EVERY} views, in the warm-up and in visits",
    f"no step leaves all Gaussians faint, no visit leaves over {ALLOWED_RISE:.0%} more error over all photos",
)
def resets(lab: Lab) -> Finding:
    """A6: density control as often as there may be any; the objective after every visit."""
    stage = make_stage(views=ring(12), points=400)
    density = DensityConfig(refine_every=REFINE_EVERY, refine_start=0.0)
    options = {"budget": 1200, "blocks": 3, "density": density}
    coordinator = lab.coordinator(stage.start(), stage.views, **options)
    faint: list[int] = []

    def listen(event: Event) -> None:
        opacities = coordinator.params["opacities"].detach().sigmoid()
        if isinstance(event, StepTaken) and len(opacities) and float(opacities.max()) <= 1.01 * FAINT:
            faint.append(event.step)

    coordinator.announce.subscribe(listen)
    worst = max(after / before - 1 for before, after in pairwise(objectives(lab, stage, coordinator)))
    said = {"abcd": f"{len(faint)} steps left all faint, worst visit {worst:+.0%}"}
    numbers = {"steps that left all faint": len(faint), "worst rise": worst}
    return Finding(not faint and worst <= ALLOWED_RISE, said, numbers)


def objectives(lab: Lab, stage: Stage, coordinator: Coordinator) -> list[float]:
    """Train to the end; the error over all training photos at the start and after each visit."""
    found = [lab.error(coordinator, stage)]

    def listen(event: Event) -> None:
        if isinstance(event, VisitEnded):
            found.append(lab.error(coordinator, stage))

    coordinator.announce.subscribe(listen)
    lab.finish(coordinator, stage)
    return found


CAMERAS = (1, 2, 3, 10, 100, 1000, 2900, 15_000)
EVERY = 100
"""Steps between splatfacto's refinements."""


def refinements(cameras: int, steps: int = 30_000) -> int:
    """How often a scene that `cameras` see is refined in a whole run."""
    control, found = DensityControl(DensityConfig()), [0]
    for step in range(1, steps + 1):
        clock = DensityClock(step / steps, step, 1, cameras, None, 0, refined=found[-1])
        found += [step] if control.is_due(clock) else []
    return len(found) - 1


def splatfacto_refines(cameras: int, steps: int = 15_000) -> int:
    """nerfstudio 1.1.5: not before `cameras` + 100 steps after a reset, and resets are 3,000 steps apart."""
    reset = 3000
    return sum(step % EVERY == 0 and step % reset >= cameras + EVERY for step in range(500, steps))


@scenario(
    "A7",
    "never densifies from 2,900 images on (nerfstudio #2927, #3743)",
    "the schedule of 30,000 steps for 1 to 15,000 cameras, and splatfacto's",
    f"at least {LEAST_REFINEMENTS} refinements",
)
def thousands(lab: Lab) -> Finding:  # noqa: ARG001 - a schedule needs no training
    """A7: the schedule alone, for captures of 1 to 15,000 photos."""
    found = {cameras: refinements(cameras) for cameras in CAMERAS}
    never = [cameras for cameras in CAMERAS if splatfacto_refines(cameras) == 0]
    said = {
        "abcd": f"{min(found.values())} to {max(found.values())} refinements with {CAMERAS[0]} to "
        f"{CAMERAS[-1]:,} cameras",
        "splatfacto": f"none at all from {min(never):,} cameras on",
    }
    passed = all(count >= LEAST_REFINEMENTS for count in found.values())
    return Finding(passed, said, {f"refinements at {cameras}": count for cameras, count in found.items()})


VISITS_RISING = 0.05
RISES_BY = 1e-3
"""A visit raised the objective if by more than this share of it."""


@scenario(
    "A13",
    "old layers oscillate and diverge",
    "layers drawn anew for each visit, without a warm-up; the full objective after each",
    f"it rises in at most {VISITS_RISING:.0%} of visits",
)
def old_layers(lab: Lab) -> Finding:
    """A13: the objective after each visit."""
    stage = make_stage(views=ring(12), points=400)
    usual = {"budget": BUDGET // 2, "warmup": 0.0, "recipe": Recipe(heal=False, passes=2)}
    usual["density"] = DensityConfig(strategy="off")
    coordinator = lab.coordinator(stage.start(), stage.views, **usual)
    errors = objectives(lab, stage, coordinator)
    rising = mean(after > (1 + RISES_BY) * before for before, after in pairwise(errors))
    score = lab.score(coordinator, stage)
    said = {"abcd": f"{rising:.0%} of visits raised the objective, {score:.2f} dB"}
    return Finding(rising <= VISITS_RISING, said, {"rising": rising, "psnr": score})


BAND = 4
"""Pixels to either side of a border."""
SEAM = 1.2
"""The error in the band, in errors of the interior, at most."""
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


@scenario(
    "A14",
    'seams, "chunk bleeding" and "ghosting" at borders (LoD of Gaussians, VastGaussian #49)',
    "a textured floor over four blocks, seen by held-out cameras",
    f"the error within {BAND} px of a border is at most {SEAM} times the interior's",
)
def seams(lab: Lab) -> Finding:
    """A14: a textured floor over four blocks."""
    held_out = above(16, turn=1.0)[::3]
    stage = make_stage(FLOOR, above(16), held_out, points=700)
    tree = build_grid(stage.start().means, counts=(2, 2, 1))
    inside = torch.stack([border_band(FLOOR, tree, view) for view in held_out])
    numbers, said = {}, {}
    for method in METHODS:
        trained = lab.train_limited(stage, method, tree=tree)
        drawn = lab.pictures(trained.gaussians, held_out)
        errors = torch.stack([(a - b).abs().mean(dim=-1) for a, b in zip(drawn, stage.truth, strict=True)])
        ratio = float(errors[inside].mean() / errors[~inside].mean())
        numbers |= {f"ratio {method}": ratio, f"psnr {method}": trained.psnr}
        said[method] = f"{ratio:.2f} of the interior's error at borders, {trained.psnr:.2f} dB"
    against = numbers["ratio abcd"] / numbers["ratio abcd-monolithic"]
    said["abcd"] += f", {against:.2f} times one block's ratio"
    numbers["against one block"] = against
    return Finding(numbers["ratio abcd"] <= SEAM, said, numbers, worse=against > 1)


CLIFF_DB = 0.5
COUNTS = (1, 2, 4, 8, 27)


@scenario(
    "A19",
    "the number of blocks decides the quality",
    f"{', '.join(map(str, COUNTS))} blocks and a grid that cuts the balls, on a budget of 600 views",
    f"worst within {CLIFF_DB} dB of the best",
)
def blocks_and_cuts(lab: Lab) -> Finding:
    """A19: the defaults with 1 to 27 blocks, and with a grid whose planes cut every ball."""
    stage = make_stage()
    psnrs = {"1 block": lab.compared(stage, "abcd-monolithic", "table")}
    psnrs |= {f"{k} blocks": lab.compared(stage, "abcd", blocks=k) for k in COUNTS if k > 1}
    cut = build_grid(stage.start().means.clamp(-0.5, 0.5), counts=(2, 2, 1))
    psnrs["4 that cut the balls"] = lab.compared(stage, "abcd", tree=cut)
    gap = max(psnrs.values()) - min(psnrs.values())
    behind = psnrs["1 block"] - min(psnrs.values())
    said = {"abcd": ", ".join(f"{name} {value:.2f}" for name, value in psnrs.items()) + " dB"}
    said["abcd-monolithic"] = f"{psnrs['1 block']:.2f} dB"
    numbers = {**{f"psnr {name}": value for name, value in psnrs.items()}, "best to worst": gap}
    return Finding(gap <= CLIFF_DB, said, numbers, worse=behind > 0)


FOG = 0.02
"""Of the screen, in the mean over training views, at most."""


@scenario(
    "A23",
    "fog before the cameras imitates each photo's vignette (drone captures)",
    "photos that darken by half towards their corners",
    f"Gaussians before the nearest point of a view take under {FOG:.0%} of the screen at any time",
)
def fog(lab: Lab) -> Finding:
    """A23: the share of the screen that fog takes, every 50 steps."""
    stage, said, most = make_stage(views=ring(12), points=400), {}, {}
    dark = {index: photo * vignette(*photo.shape[:2]) for index, photo in stage.photos.items()}
    for method in PAIR:
        coordinator = lab.coordinator(stage.start(), stage.views, method, budget=BUDGET)
        shares = [0.0]
        while not coordinator.finished:
            train_step(coordinator, replace(stage, photos=dark))
            if coordinator.state.step % 50 == 0:
                shares.append(share_of_fog(lab, merged(coordinator), stage.views))
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
