"""A4, A9, A14, A15: empty blocks, blocks that few cameras see, seams where blocks meet, floaters."""

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.render.splat_kernels import MIN_ALPHA
from abcd_ns.engine.space.intervals import ray_interval
from abcd_ns.engine.space.partition import build_grid, build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.health_record import standing
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.lab.stability.lab import METHODS, PAIR, STILL, Lab, Stage, Trained, block_at, make_stage, merged
from abcd_ns.lab.stability.outcome import Finding, scenario
from abcd_ns.lab.world.world import TABLE, Ball, Surfaces, Wall, World, camera, ring

CLUSTERS = ((-20.0, 0), (-30.0, 1), (-40.0, 2))
"""How deep under the table balls lie, and how many cameras stand there."""
VISIT = 3
"""Steps of a visit: each of the views is used once, so that nobody can tell that its pictures got worse."""


def equal(a: Gaussians, b: Gaussians) -> bool:
    """Bit for bit."""
    return len(a) == len(b) and all(torch.equal(value, getattr(b, name)) for name, value in a.items())


@scenario(
    "A4",
    "no Gaussian left: crashes (Inria #472, splatfacto-w #12)",
    "a block without Gaussians, a view of nothing, and a block whose Gaussians all go",
    "every operation works with none; the other blocks stay bit-equal; the run ends",
)
def nobody_left(lab: Lab) -> Finding:
    """A4: a block that is empty from the start, a view of nothing, and a block that loses all it has."""
    world = Surfaces(TABLE.surfaces[:-1])
    away = camera((0.0, 0.0, 3.0), (0.0, 0.01, 9.0), 12)
    stage = make_stage(world, [*ring(12), away], points=300)
    tree = build_kd(stage.start().means, 3)
    tree = tree.split(block_at(tree, 0.0, 0.0, 9.0), 2, 8.0)
    coordinator = lab.coordinator(
        stage.start(),
        stage.views,
        budget=240,
        tree=tree,
        warmup=0.0,
        recipe=Recipe(visit_steps=VISIT),
        batch=4,
    )
    empty = block_at(tree, 0.0, 0.0, 9.0)
    lab.finish(coordinator, stage, steps=VISIT)
    kept, emptied = _prune_a_visit(coordinator, stage)
    passed = kept and coordinator.scene.count(emptied) == 0 and coordinator.scene.count(empty) == 0
    lab.finish(coordinator, stage)
    score = lab.score(coordinator, stage)
    passed &= coordinator.finished and bool(torch.isfinite(torch.tensor(score)))
    passed &= len(merged(coordinator)) > 0
    said = {"abcd": f"block {emptied + 1} lost all its Gaussians, others bit-equal: {kept}; the run ended"}
    return Finding(passed, said, {"psnr": score, "emptied": coordinator.scene.count(emptied)})


def _prune_a_visit(coordinator: Coordinator, stage: Stage) -> tuple[bool, int]:
    """Make all of the next block transparent in the midst of its visit; whether others stayed, and which."""
    train_step(coordinator, stage)
    block = coordinator.state.active.geometry.block
    scene = coordinator.scene
    others = {b: scene.gaussians(b) for b in range(scene.tree.num_blocks) if b != block}
    with torch.no_grad():
        coordinator.params["opacities"].fill_(-20.0)
    coordinator.visit.live.growth["weight"].zero_()  # nor do statistics remember that they ever showed
    while coordinator.state.active is not None:
        train_step(coordinator, stage)
    return all(equal(scene.gaussians(b), gaussians) for b, gaussians in others.items()), block


def few_cameras() -> tuple[Stage, BlockTree]:
    """A table that 12 cameras see, and deep below it balls that 0, 1 and 2 cameras see, each a block."""
    balls = [Ball((0.0, 0.0, depth), 0.2) for depth, _ in CLUSTERS]
    world, views = Surfaces((*TABLE.surfaces[:-1], *balls)), ring(12)
    for depth, count in CLUSTERS:
        for k in range(count):
            views.append(camera((0.9 * (1 - 2 * k), -0.5, depth), (0.0, 0.0, depth), len(views)))
    stage = make_stage(world, views, points=390)
    draw = {"generator": torch.Generator().manual_seed(3)}
    for ball in balls:
        shell = torch.nn.functional.normalize(torch.randn((40, 3), **draw), dim=1) * ball.radius
        points = torch.cat([stage.points, shell.double() + torch.tensor(ball.center)])
        stage = replace(stage, points=points, colors=torch.cat([stage.colors, torch.full((40, 3), 128.0)]))
    tree = build_kd(torch.zeros(0, 3), 1)
    for depth in (-10.0, -25.0, -35.0):  # the part below a cut keeps its number: name the parts from below
        tree = tree.split(block_at(tree, 0.0, 0.0, depth), 2, depth)
    return stage, tree


@scenario(
    "A9",
    "blocks silently untrained (VastGaussian #32, H3DGS #67, #77)",
    "blocks that 0, 1 and 2 cameras see",
    "each block's state is said; the unobserved one is bit-equal and not densified",
)
def observed(lab: Lab) -> Finding:
    """A9: train, and ask each block how it stands."""
    stage, tree = few_cameras()
    start = stage.start()
    at = {count: block_at(tree, 0.0, 0.0, depth) for depth, count in CLUSTERS}
    unseen = start[tree.assign(start.means) == at[0]]
    options = {"budget": lab.views_drawn(280), "tree": tree, "warmup": 0.0}
    coordinator = lab.coordinator(start, stage.views, **options)
    lab.finish(coordinator, stage)
    state = coordinator.state
    words = {count: standing(b, state.health.get(b), state.views) for count, b in at.items()}
    same = equal(coordinator.scene.gaussians(at[0]), unseen)
    passed = same and "no view" in words[0] and "1 view" in words[1] and "2 views" in words[2]
    said = {"abcd": "; ".join(f"{count} cameras: {text}" for count, text in words.items())}
    visits = {f"visits with {count}": coordinator.scene.clocks(b).visits for count, b in at.items()}
    mono = lab.coordinator(start, stage.views, "abcd-monolithic", budget=lab.views_drawn(100), density=STILL)
    lab.finish(mono, stage)
    below = merged(mono).means[:, 2] < -15.0
    said["abcd-monolithic"] = f"says nothing of the {int(below.sum())} Gaussians that few cameras see"
    return Finding(passed, said, {"unseen block bit-equal": float(same), **visits})


BAND = 4
"""Pixels to either side of a border."""
SEAM = 1.2
"""The error in the band, in errors of the interior, at most."""
FLOOR = Surfaces((Wall(2, 0.0, 0.8, 0.8),))
BACK = Surfaces((Wall(1, 0.6, 1.2),))
AIR = (-0.5, 0.2)
"""Where along y nothing is, between cameras at -1.2 and the wall."""
FLOATERS = 60
ALPHA = 0.01


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


def band_ratio(lab: Lab, trained: Trained, bands: list[Tensor], stage: Stage) -> float:
    """Mean absolute error of held-out pictures in the bands, over that outside them."""
    drawn = lab.pictures(trained.gaussians, stage.held_out)
    errors = torch.stack([(a - b).abs().mean(dim=-1) for a, b in zip(drawn, stage.truth, strict=True)])
    inside = torch.stack(bands)
    return float(errors[inside].mean() / errors[~inside].mean())


@scenario(
    "A14",
    'seams, "chunk bleeding" and "ghosting" at borders (LoD of Gaussians, VastGaussian #49)',
    "a textured floor over four blocks, seen by held-out cameras",
    f"the error within {BAND} px of a border is at most {SEAM} times the interior's",
    cost=2,
)
def seams(lab: Lab) -> Finding:
    """A14: a textured floor over four blocks."""
    held_out = above(16, turn=1.0)[::3]
    stage = make_stage(FLOOR, above(16), held_out, points=700)
    tree = build_grid(stage.start().means, counts=(2, 2, 1))
    bands = [border_band(FLOOR, tree, view) for view in held_out]
    numbers, said = {}, {}
    for method in METHODS:
        trained = lab.train_limited(stage, method, tree=tree)
        ratio = band_ratio(lab, trained, bands, stage)
        numbers |= {f"ratio {method}": ratio, f"psnr {method}": trained.psnr}
        said[method] = f"{ratio:.2f} of the interior's error at borders, {trained.psnr:.2f} dB"
    against = numbers["ratio abcd"] / numbers["ratio abcd-monolithic"]
    said["abcd"] += f", {against:.2f} times one block's ratio"
    numbers["against one block"] = against
    return Finding(numbers["ratio abcd"] <= SEAM, said, numbers, worse=against > 1)


def alpha_in_air(lab: Lab, trained: Trained, tree: BlockTree, views: list[View]) -> Float[Tensor, ""]:
    """Mean alpha over the pictures of what is drawn in the cell of air."""
    cell, gaussians = tree.cell(block_at(tree, 0.0, 0.0, 0.0)), trained.gaussians
    alphas = []
    for view in views:
        window = ray_interval(cell, view, lab.rasterizer.window_grid(view.full))
        with torch.no_grad():
            raster = lab.rasterizer(gaussians, view, sh_degree=gaussians.sh_degree, z_window=window)
        alphas.append(1 - raster.transmittance)
    return torch.stack(alphas).mean()


@scenario(
    "A15",
    "floaters in the air between cameras and scene (BlockGaussian)",
    f"{FLOATERS} points in the air before a wall, in a cell of their own",
    f"less than {ALPHA:.0%} alpha in that cell in held-out views; Gaussians left there are counted",
    cost=2,
)
def floaters(lab: Lab) -> Finding:
    """A15: points in the air between cameras and a wall, in a cell of their own."""
    views = [
        camera((0.13 * (k - 5.5), -1.2, 0.15 * (k % 3 - 1)), (0.06 * (k - 5.5), 0.6, 0.0), k)
        for k in range(12)
    ]
    held_out = [camera((0.13 * (k - 3), -1.2, 0.05), (0.06 * (k - 3), 0.6, 0.0), k) for k in range(6)]
    stage = make_stage(BACK, views, held_out, points=500)
    draw = torch.rand((FLOATERS, 3), generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    low, high = torch.tensor([-0.6, AIR[0] + 0.02, -0.3]), torch.tensor([0.6, AIR[1] - 0.02, 0.3])
    points = torch.cat([stage.points, low + (high - low) * draw])
    stage = replace(stage, points=points, colors=torch.cat([stage.colors, torch.full((FLOATERS, 3), 128.0)]))
    tree = build_kd(torch.zeros(0, 3), 1).split(0, 1, AIR[0]).split(1, 1, AIR[1])
    tree = tree.split(block_at(tree, 0.0, 0.6, 0.0), 0, 0.0)
    numbers, said = {}, {}
    for method in PAIR:
        trained = lab.train_limited(stage, method, tree=tree)
        alpha = float(alpha_in_air(lab, trained, tree, held_out))
        gaussians = trained.gaussians
        inside = (gaussians.means[:, 1] > AIR[0]) & (gaussians.means[:, 1] < AIR[1])
        left = int((inside & (torch.sigmoid(gaussians.opacities[:, 0]) > MIN_ALPHA)).sum())
        numbers |= {f"alpha {method}": alpha, f"left {method}": left, f"psnr {method}": trained.psnr}
        said[method] = (
            f"{alpha:.2%} alpha in the air, {left} of {FLOATERS} Gaussians left, {trained.psnr:.2f} dB"
        )
    worse = numbers["alpha abcd"] > numbers["alpha abcd-monolithic"]
    passed = numbers["alpha abcd"] < ALPHA
    return Finding(passed, said, numbers, worse=worse)
