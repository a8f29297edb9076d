"""A14, A15: seams where blocks meet, and floaters where nothing is."""

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.render.splat_kernels import MIN_ALPHA
from abcd_ns.engine.space.intervals import ray_interval
from abcd_ns.engine.space.partition import build_grid, build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.types import View
from abcd_ns.lab.stability.lab import METHODS, PAIR, Lab, Stage, Trained, block_at, make_stage
from abcd_ns.lab.stability.outcome import Finding, scenario
from abcd_ns.lab.world.world import Surfaces, Wall, World, camera

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
