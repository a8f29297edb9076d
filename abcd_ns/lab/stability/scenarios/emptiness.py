"""A4, A9: blocks with nothing in them, and blocks that few cameras see or none."""

from dataclasses import replace

import torch

from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.health_record import standing
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians
from abcd_ns.lab.stability.lab import STILL, Lab, Stage, block_at, make_stage, merged
from abcd_ns.lab.stability.outcome import Finding, scenario
from abcd_ns.lab.world.world import TABLE, Ball, Surfaces, camera, ring

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
