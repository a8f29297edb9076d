"""A1, A2, A22: values that are no numbers, too few points, colours over 1 and what nobody can see."""

import math
import warnings
from dataclasses import replace

import torch

from abcd_ns.engine.events import Mended
from abcd_ns.engine.gaussians.initialize import gaussians_from_points, random_points
from abcd_ns.engine.gaussians.param_swap import Optimizers, nothing_live
from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.layers.compositing import composite
from abcd_ns.engine.layers.layer_store import packed, rounded, unpacked
from abcd_ns.engine.layers.painter import FrozenLayers
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.health.health_rules import unsound
from abcd_ns.engine.train.health_record import standing
from abcd_ns.engine.train.planner import NothingSeenError
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from abcd_ns.lab.stability.lab import PAIR, SH_DEGREE, STILL, Lab, Trained, make_stage, merged
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
        passes=1,
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
