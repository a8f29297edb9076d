"""A1 to A3, A8, A17, A22: no numbers, too few points; Gaussians too large, faint, far or hidden."""

import math
import warnings
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import Mended
from abcd_ns.engine.gaussians.initialize import gaussians_from_points, random_points
from abcd_ns.engine.gaussians.param_swap import Optimizers, nothing_live
from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.layers.compositing import composite
from abcd_ns.engine.layers.layer_store import packed, rounded, unpacked
from abcd_ns.engine.layers.painter import FrozenLayers, Painter, PaintSettings
from abcd_ns.engine.render import Shot
from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.render.splat_kernels import MIN_ALPHA
from abcd_ns.engine.space.influence import weights
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.health.health_rules import GIANT_ANGLE, unsound
from abcd_ns.engine.train.health_record import standing
from abcd_ns.engine.train.planner import NothingSeenError
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.engine.types import PARAM_NAMES, Gaussians, View
from abcd_ns.lab.stability.lab import (
    BLOCKS,
    PAIR,
    SH_DEGREE,
    STILL,
    Lab,
    Stage,
    Trained,
    block_at,
    make_stage,
    merged,
)
from abcd_ns.lab.stability.outcome import Finding, db, scenario
from abcd_ns.lab.world.world import TABLE, Ball, Surfaces, ring

ONE_IN = 200
POINTS = {
    "no point": torch.zeros(0, 3),
    "1 point": torch.zeros(1, 3),
    "2 points": torch.tensor([[0.0, 0, 0], [0.1, 0, 0]]),
    "3 points": torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]),
    "4 points": torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]),
    "5 equal points": torch.full((5, 3), 0.05),
    "5 points in a line": torch.linspace(-0.2, 0.2, 5)[:, None] * torch.tensor([[1.0, 0, 0]]),
}
"""What a reconstruction that all but failed may leave."""
OPAQUE = {"opacities": 8.0, "scales": math.log(0.05)}
"""Of the wall around the hidden block."""


def poison(optimizers: Optimizers, params: dict) -> None:
    """From now on one gradient in ONE_IN of every parameter is NaN, another one in each step."""
    taken = dict.fromkeys(PARAM_NAMES, 0)

    def spoil(name: str):
        def before_step(optimizer, args, kwargs) -> None:  # noqa: ARG001 - torch's signature
            gradient, taken[name] = params[name].grad, taken[name] + 1
            if gradient is not None:
                gradient[taken[name] % ONE_IN :: ONE_IN] = math.nan

        return before_step

    for name, optimizer in optimizers.items():
        optimizer.register_step_pre_hook(spoil(name))


def stored_soundly(trained: Trained) -> bool:
    """Whether all that the store holds, moments and statistics included, are numbers."""
    scene = trained.coordinator.scene
    loaded = [scene.state(block).packed()[0] for block in range(scene.tree.num_blocks)]
    return all(bool(torch.isfinite(value).all()) for tensors in loaded for value in tensors.values())


@scenario(
    "A1",
    "NaN in a few splats; image and loss look fine (brush #522, gsplat #248)",
    f"NaN in one gradient of {ONE_IN}, in every step and every parameter",
    "mended and counted, never stored, PSNR within 0.1 dB of a run without",
)
def nan_gradients(lab: Lab) -> Finding:
    """A1: train twice, once with NaN in some gradients of every step."""
    stage, said, numbers, passed = make_stage(views=ring(12), points=400), {}, {}, True
    budget = lab.views_drawn(200)
    for method in PAIR:
        options = {"budget": budget, "blocks": 4, "density": STILL}
        clean = lab.train(stage, method, **options)
        live = nothing_live(SH_DEGREE)
        poison(live[1], live[0])
        spoilt = lab.train(stage, method, optimizers=live, **options)
        mended = sum(event.count for event in spoilt.of(Mended) if event.what == "gradients")
        lost = clean.psnr - spoilt.psnr
        numbers |= {f"lost {method}": lost, f"mended {method}": mended}
        said[method] = f"{mended:,} gradients mended, {db(lost)} lost"
        passed &= mended > 0 and stored_soundly(spoilt) and abs(lost) <= 0.1
    return Finding(passed, said, numbers)


@scenario(
    "A2",
    "4 equal points give log(0), fewer than 4 crash (splatfacto)",
    "runs from 0 to 4 points, 5 equal ones, 5 in a line",
    "all values finite, a warning where there are too few, every run ends or says why it cannot go on",
)
def hardly_any_points(lab: Lab) -> Finding:
    """A2: runs that begin from next to nothing."""
    stage, said, passed, warned = make_stage(views=ring(6), points=60), {}, True, 0
    refused: list[str] = []
    for name, points in POINTS.items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            if len(points) == 0:
                points, _ = random_points(50, 1.0)  # as the model does
            start = gaussians_from_points(points, torch.full((len(points), 3), 128.0), sh_degree=SH_DEGREE)
        few = any("too few" in str(warning.message) for warning in caught)
        passed &= few == (name.startswith(("1 ", "2 ", "3 ", "5 equal")))
        warned += few
        coordinator = lab.coordinator(start, stage.views, budget=40, blocks=4)
        try:
            lab.finish(coordinator, stage)
        except NothingSeenError:  # all that there was has been pruned
            refused.append(name)
        passed &= not bool(unsound(merged(coordinator)).any())
    ended = len(POINTS) - len(refused)
    said["abcd"] = f"{ended} runs ended, all values finite, {warned} warnings"
    said["abcd"] += f"; no Gaussian was left of {', '.join(refused)}, and that was said" if refused else ""
    return Finding(passed, said, {"runs": ended, "refused": len(refused), "warnings": warned})


@scenario(
    "A22",
    "colours over 1 clipped; transmittance saturates",
    "a colour of 1.6 through a layer of half floats; a block inside an opaque ball",
    "the colour survives; the hidden block is visited once, then passed over, and said to be hidden",
)
def bright_and_hidden(lab: Lab) -> Finding:
    """A22: a colour of 1.6 through a layer, and a block that an opaque one hides."""
    stage = make_stage(TABLE, ring(4, size=(24, 18)), ring(1, turn=0.5, size=(24, 18)), points=40)
    bright = replace(stage.start(), features_dc=torch.full((len(stage.points), 3), 1.1 / SH_C0))
    bright = replace(bright, opacities=torch.full_like(bright.opacities, 4.0), scales=bright.scales + 1)
    layer = lab.rasterizer(bright, stage.views[0], sh_degree=0).layer
    back = unpacked(rounded(packed(FrozenLayers(layer, layer))).float()).back
    brightest = float(back.color.max())
    # Behind half a pane, 1.6 is 0.8: it must not be clipped before that.
    dimmed = float(composite(replace(back, color=0.5 * back.color), torch.zeros(3)).max())
    coordinator, core = hidden_block(lab)
    state = coordinator.state
    words = standing(core, state.health.get(core), state.views)
    visits = coordinator.scene.clocks(core).visits
    passed = brightest > 1.5 and dimmed > 0.75 and "hidden" in words and visits == 1
    said = {"abcd": f"colour {brightest:.2f} kept; the block behind the wall is {words}"}
    return Finding(passed, said, {"brightest": brightest, "dimmed": dimmed})


def hidden_block(lab: Lab) -> tuple[Coordinator, int]:
    """Two sweeps over a scene in which an opaque ball hides a block; the block's number."""
    stage = make_stage(
        Surfaces((Ball((0.0, 0.0, 0.0), 0.3), Ball((0.0, 0.0, 0.0), 4.0))), ring(6), ring(2), 300
    )
    draw = {"generator": torch.Generator().manual_seed(1)}
    shell = torch.nn.functional.normalize(torch.randn((900, 3), **draw), dim=1) * 0.3
    wall = gaussians_from_points(shell, torch.full((900, 3), 128.0), sh_degree=SH_DEGREE)
    opaque = {name: torch.full_like(getattr(wall, name), value) for name, value in OPAQUE.items()}
    inside = 0.02 * torch.randn((30, 3), **draw)
    hidden = gaussians_from_points(inside, torch.full((30, 3), 255.0), sh_degree=SH_DEGREE)
    tree, core = box_around_origin(0.12)
    coordinator = lab.coordinator(
        Gaussians.cat([stage.start(), replace(wall, **opaque), hidden]),
        stage.views,
        budget=10_000,
        tree=tree,
        warmup=0.0,
        density=STILL,
        recipe=Recipe(passes=1),
    )
    while coordinator.state.sweep < 2:
        lab.finish(coordinator, stage, steps=1)
    return coordinator, core


def box_around_origin(half: float) -> tuple[BlockTree, int]:
    """Seven cells, one of them a box around the origin; and which."""
    tree, origin = build_kd(torch.zeros(0, 3), 1), torch.zeros(1, 3)
    for axis in range(3):
        for at in (-half, half):
            tree = tree.split(int(tree.assign(origin)), axis, at)
    return tree, int(tree.assign(origin))


SIGMAS = (1.0, 3.0, 10.0)
"""Of the giants that are put in, in extents of their cell."""
GAP_DB = 40.0
OFFSETS = (0.0, 5e5, 5e6)
"""Metres; coordinates of national grids."""
OUTLIER = 1e7
EMPTY_CELLS = 10


def with_giants(start: Gaussians, tree, sigmas=SIGMAS) -> Gaussians:
    """`start` with the Gaussian amid each of the first blocks so many extents wide."""
    owner, scales, opacities = tree.assign(start.means), start.scales.clone(), start.opacities.clone()
    for block, sigma in enumerate(sigmas):
        rows = (owner == block).nonzero()[:, 0]
        middle = start.means[rows].median(dim=0).values
        giant = rows[(start.means[rows] - middle).norm(dim=1).argmin()]
        scales[giant], opacities[giant] = math.log(sigma * _extent(start.means[rows])), 0.0
    return replace(start, scales=scales, opacities=opacities)


def _extent(means: Float[Tensor, "n 3"]) -> float:
    """The longest side of the box that holds all means but the outermost hundredths."""
    ranked, last = means.sort(dim=0).values, len(means) - 1
    low, high = round(0.01 * last), round(0.99 * last)
    return float((ranked[high] - ranked[low]).max())


def largest_share(gaussians: Gaussians, views: list[View]) -> float:
    """The largest standard deviation, as a share of what a Gaussian of its distance may have."""
    nearest = torch.cdist(gaussians.means, torch.stack([view.center for view in views])).amin(dim=1)
    return float((gaussians.scales.amax(dim=1).exp() / (GIANT_ANGLE * nearest)).max())


def ordering_gap(lab: Lab, trained: Trained, views: list[View]) -> float:
    """PSNR between merged and composited pictures, dB; at most 200."""
    scene, gaussians = trained.coordinator.scene, trained.gaussians
    painter = Painter(scene, views, lab.rasterizer, ownership="fragments", pass_gaussians=0)
    settings = PaintSettings(gaussians.sh_degree)
    drawn = [painter.picture(view, settings).color.clamp(0, 1) for view in views]
    gaps = [psnr(a, b) for a, b in zip(drawn, lab.pictures(gaussians, views), strict=True)]
    return min(float(torch.stack(gaps).mean()), 200.0)


@scenario(
    "A3",
    "needles and giants: half of garden's splats, the worst 3857 frames wide (brush #479)",
    "Gaussians with sigma = 1, 3 and 10 extents of their cell among the first ones",
    f"shrunk by a block's refinements, none over 1.25 of what is allowed; ordering gap >= {GAP_DB:g} dB",
    cost=2,
)
def giants(lab: Lab) -> Finding:
    """A3: three giants among the first Gaussians; two sweeps, so that each block is refined once."""
    stage = make_stage(views=ring(12), points=400)
    tree = build_kd(stage.start().means, BLOCKS)
    start, numbers, said = with_giants(stage.start(), tree), {}, {}
    before = largest_share(start, stage.views)
    eager = DensityConfig(refine_start=0.0, refine_stop=1.0)
    for name, heal in (("abcd", True), ("abcd, not healing", False)):
        options = {"budget": lab.views_drawn(320), "tree": tree, "warmup": 0.0, "density": eager}
        trained = lab.train(stage, start=start, recipe=Recipe(heal=heal), **options)
        after = largest_share(trained.gaussians, stage.views)
        gap = ordering_gap(lab, trained, stage.held_out[:4])
        held = [event.visit for event in trained.of(Mended) if event.what == "giants"]
        numbers |= {f"largest {name}": after, f"gap {name}": gap, f"visits {name}": len(held)}
        said[name] = f"largest {before:.1f} -> {after:.2f} of what is allowed, gap {gap:.0f} dB"
    mono = lab.train(stage, "abcd-monolithic", start=start, budget=lab.views_drawn(320), density=eager)
    left = largest_share(mono.gaussians, stage.views)
    said["abcd-monolithic"] = f"largest {before:.1f} -> {left:.2f}"
    passed = numbers["largest abcd"] < 1.25 and numbers["gap abcd"] >= GAP_DB and numbers["visits abcd"] > 0
    return Finding(passed, said, {"largest before": before, **numbers, "largest abcd-monolithic": left})


def unseen_weights(lab: Lab, gaussians: Gaussians, views: list[View]) -> Tensor:
    """[n] the sum of each Gaussian's weights over all views."""
    shots = [Shot(view, view.full) for view in views]
    return weights(gaussians, lab.rasterizer, shots).sum(dim=0)


@scenario(
    "A8",
    "75% of the exported splats are transparent (gsplat #822)",
    f"a third of the first Gaussians all but transparent, pruning off; {EMPTY_CELLS} empty cells",
    "no exported Gaussian below 1/255; empty cells stay empty. Those that only the training views do not "
    "see are counted and stay: a new view may see them",
)
def transparent(lab: Lab) -> Finding:
    """A8: what an export holds that nobody can see; and cells that begin empty."""
    stage, numbers, said = make_stage(views=ring(12), points=500), {}, {}
    start = stage.start()
    faint = replace(start, opacities=start.opacities - 4.0 * (torch.arange(len(start)) % 3 == 0)[:, None])
    tree = build_kd(start.means, BLOCKS)
    for k in range(EMPTY_CELLS):
        tree = tree.split(block_at(tree, 0.0, 0.0, 50.0 + k), 2, 50.5 + k)
    for method in PAIR:
        options = {
            "budget": lab.views_drawn(320),
            "tree": tree,
            "density": DensityConfig(cull_alpha_thresh=0),
        }
        trained = lab.train(stage, method, start=faint, **options)
        export = trained.gaussians
        invisible = int((torch.sigmoid(export.opacities) < MIN_ALPHA).sum())
        unseen = int((unseen_weights(lab, export, stage.views) == 0).sum()) - invisible
        scene = trained.coordinator.scene
        grown = sum(map(scene.count, range(BLOCKS, scene.tree.num_blocks)))
        numbers |= {f"invisible {method}": invisible, f"unseen {method}": unseen, f"grown {method}": grown}
        said[method] = f"{invisible} of {len(export)} below 1/255, {unseen} unseen by the training views"
    said["abcd"] += f", {numbers['grown abcd']} in {EMPTY_CELLS} empty cells"
    return Finding(numbers["invisible abcd"] == 0 and numbers["grown abcd"] == 0, said, numbers)


@scenario(
    "A17",
    "one outlier spoils the octree (GaussianSplats3D #299); UTM offsets eat float32",
    "a point at 1e7 m; coordinates that begin at 0, 5e5 and 5e6 m",
    "blocks as even as without it, at most 0.1 dB lost; 0.05 dB between offsets",
)
def far_away(lab: Lab) -> Finding:
    """A17: a point at 1e7; and captures in coordinates of national grids."""
    stage, numbers, said = make_stage(views=ring(12), points=400), {}, {}
    budget = lab.views_drawn(160)
    options = {"budget": budget, "blocks": BLOCKS, "density": STILL}
    plain = lab.train(stage, **options)
    where = torch.cat([stage.points, stage.points.new_tensor([[OUTLIER, 0, 0]])])
    outlier = lab.train(
        replace(stage, points=where, colors=torch.cat([stage.colors, stage.colors[:1]])), **options
    )
    largest = int(outlier.coordinator.scene.tree.assign(where.float()).bincount().max())
    numbers |= {"lost to outlier": plain.psnr - outlier.psnr, "largest block": largest}
    moved = [lab.train(surveyed(stage, offset), **options).psnr for offset in OFFSETS]
    numbers |= {f"offset {offset:g}": score for offset, score in zip(OFFSETS, moved, strict=True)}
    spread = max(moved) - min(moved)
    even = largest <= math.ceil(len(where) / BLOCKS)
    passed = even and numbers["lost to outlier"] <= 0.1 and spread <= 0.05
    said["abcd"] = f"outlier: {db(numbers['lost to outlier'])} lost; offsets to 5e6 m: {db(spread)} apart"
    return Finding(passed, said, {**numbers, "spread": spread})


def surveyed(stage: Stage, offset: float) -> Stage:
    """The stage as it is read from a file whose coordinates begin at `offset` metres."""
    from abcd_ns.data.normalize import normalizing_similarity  # loads nerfstudio

    flip = np.diag([1.0, -1.0, -1.0])
    rows = [view.viewmat.double().numpy() for view in stage.views + stage.held_out]
    shift = np.array([offset, -offset, 0.1 * offset])
    poses = np.stack(
        [
            np.concatenate([r[:3, :3].T @ flip, (-r[:3, :3].T @ r[:3, 3] + shift)[:, None]], axis=1)
            for r in rows
        ]
    )
    similarity = normalizing_similarity(poses, "none", "poses", False, 1.0)
    placed = []
    for view, pose in zip(stage.views + stage.held_out, similarity.poses(poses), strict=True):
        rotation, center = pose[:, :3] @ flip, pose[:, 3]
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ center
        placed.append(replace(view, viewmat=torch.from_numpy(matrix).float()))
    points = torch.from_numpy(similarity.points(stage.points.double().numpy() + shift))
    count = len(stage.views)
    return replace(stage, views=placed[:count], held_out=placed[count:], points=points)
