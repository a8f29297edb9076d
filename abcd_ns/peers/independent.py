"""Partition, train, merge: every block is trained once, by itself, on its cell and a margin around it.

What published systems do that train large scenes by parts, in this engine's terms:

- A block begins with the Gaussians of its cell enlarged by `overlap`, as in VastGaussian (Lin et al., CVPR
  2024) and Mega-NeRF (Turki et al., CVPR 2022). It knows nothing of its neighbours' training.
- It is trained on the pixels whose surface lies in the enlarged cell, as Mega-NeRF prunes its data. The
  surface is that of the initial points, or the ray's far end. So each pixel is some block's.
- Where the surface lies behind the cell, or the ray misses it, the target is the background, another one in
  every step. Without that, blocks fill with floaters before others' surfaces. VastGaussian's airspace-aware
  choice of cameras and BlockGaussian's auxiliary points are against the same.
- At the end it keeps the Gaussians whose means lie in its cell; all blocks together are the scene.

A block has one visit, whose share of the budget is that of its views, and over which every schedule runs. The
store also holds each block as it began, under numbers of its own.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import BlockState, Packed, join
from abcd_ns.engine.gaussians.initialize import PointCloud
from abcd_ns.engine.gaussians.param_swap import Params, active_gaussians
from abcd_ns.engine.layers.footprints import VisitGeometry, footprints
from abcd_ns.engine.render.z_window import TileGrid
from abcd_ns.engine.space.intervals import ray_interval
from abcd_ns.engine.space.tree import BlockTree, Box
from abcd_ns.engine.store.coarse_model import stored_blocks
from abcd_ns.engine.store.special_blocks import BlockName, initial_of
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.planner import NothingSeenError, Visits
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import UNLIMITED, ActiveVisit, VisitKind
from abcd_ns.engine.train.schedule import evenly, plan_epoch
from abcd_ns.engine.train.step.batch import Batch
from abcd_ns.engine.types import Crop, Gaussians, View

SURFACE_OPACITY = 0.9  # of the initial points where they stand for surfaces
SURFACE_SCALE = 0.5  # their size as such: outliers, which begin large, hide too much
BEYOND = 1e30  # camera z of a pixel that shows no point: further than any finite cell
OWN, CLEAR = 1, 2
"""What a pixel is to a block, by where its surface lies. In the enlarged cell: the block explains the photo.
Behind it, or the ray misses the cell: the block must let all light through. Any other is 0: the cell lies
behind the surface, and nothing tells what is there."""
Region = tuple[Crop, UInt8[Tensor, "_h _w"]]
"""The part of a view that shows a block, and what its pixels are to the block."""


def independent_blocks(tree: BlockTree, start: Gaussians | PointCloud) -> Iterator[tuple[BlockName, Packed]]:
    """The first content of a store: every block, and once more every block as it began."""
    for block, content in stored_blocks(tree, start):
        yield from ((block, content), (initial_of(block), content))


def enlarged(cell: Box, means: Float[Tensor, "n 3"], overlap: float) -> Box:
    """The cell, moved outward at each face by `overlap` of its extent on that axis. Where that is infinite,
    its Gaussians' means stand for it, a twentieth at either end left out."""
    extent = cell.upper - cell.lower
    if len(means):
        low, high = torch.from_numpy(np.quantile(means.double().cpu().numpy(), (0.05, 0.95), axis=0))
        extent = torch.where(extent.isinf(), high - low, extent)
    margin = overlap * torch.where(extent.isinf(), 0.0, extent)
    return Box(cell.lower - margin, cell.upper + margin)


@torch.no_grad()
def surface_depths(run: TrainingRun) -> dict[int, Float[Tensor, "_h _w"]]:
    """By view, how far the initial points are at every pixel, on the CPU; BEYOND where they cover less than
    half of one."""
    blocks = range(run.scene.tree.num_blocks)
    gaussians = Gaussians.cat([run.scene.stored(initial_of(block)) for block in blocks])
    scales = gaussians.scales + math.log(SURFACE_SCALE)
    opacities = torch.full_like(gaussians.opacities, math.log(SURFACE_OPACITY / (1 - SURFACE_OPACITY)))
    points, found = replace(gaussians, opacities=opacities, scales=scales).to(run.device), {}
    for index, view in run.views.items():
        raster = run.rasterizer(points, view, sh_degree=0)
        alpha = 1 - raster.transmittance
        depth = torch.where(alpha > 0.5, raster.depth / alpha.clamp_min(1e-10), BEYOND)
        found[index] = depth.float().cpu()
    return found


def pixel_kinds(depth: Float[Tensor, "h w"], view: View, cell: Box) -> UInt8[Tensor, "h w"]:
    """What every pixel of `view`, whose surface lies at `depth`, is to a block with this cell: OWN, CLEAR or
    0."""
    depth = depth.to(view.viewmat)
    span = ray_interval(cell, view, TileGrid(view.full, 1))
    near, far = (plane.view_as(depth) for plane in (span.near, span.far))
    own = (near <= depth) & (depth < far)
    hidden = (depth < near) & near.isfinite()
    return (OWN * own + CLEAR * (~own & ~hidden)).to(torch.uint8)


class BlocksAlone(Visits):
    """Visits each block once, in its enlarged cell, for its share of the budget."""

    def __init__(self, run: TrainingRun) -> None:
        self._run, self._scene = run, run.scene
        self._depths: dict[int, Float[Tensor, "_h _w"]] = {}
        self._looked_at: tuple[int, dict[int, Region]] = -1, {}
        self._part = 1.0

    def begin(self, at_once: int = 1) -> ActiveVisit:  # noqa: ARG002 - by itself
        """The next block's one visit; the block is persisted with what lies around it."""
        run, state = self._run, self._run.state
        began, since = run.stopwatch.seconds, run.progress
        if not state.views:
            self._plan()
        plans = state.queue
        share = plans[0].steps / sum(plan.steps for plan in plans)
        block = plans.pop(0).block
        crops = {view: crop for view, (crop, _) in self._regions(block).items()}
        state.active = ActiveVisit(
            number=state.visit,
            kind=VisitKind.ISOLATED,
            geometry=VisitGeometry(block, crops),
            sh_degree=0,
            steps=UNLIMITED,
            views=tuple(sorted(crops)),
            began=began,
            since=since,
            until=since + (1 - since) * share if plans else 1.0,
        )
        state.visit += 1
        run.persist(self._scene.tree, {block: self._joined(block)}, run.config.commit_seconds)
        return state.active

    def attached(self, active: ActiveVisit, params: Params) -> Callable[[], Gaussians]:
        """Others see the block as it will be merged."""
        block = active.geometry.block
        self._regions(block)  # found now, not in the first step
        begun = sum(self._scene.rows(initial_of(b)) for b in range(self._run.blocks))
        self._part = len(self._joined(block)) / begun
        cell = self._scene.tree.cell(block)

        def inside() -> Gaussians:
            gaussians = active_gaussians(params)
            return gaussians[cell.contains(gaussians.means)]

        return inside

    def room(self) -> int | None:
        """The block's part of the scene's limit, and what the device leaves."""
        sole, whole = self._run.config.limits.sole_limit, self._run.config.density.limit
        limits = [sole] if sole else []
        limits += [] if whole is None else [int(whole * self._part)]
        return min(limits) - len(self._run.params["means"]) if limits else None

    def compared(
        self, batch: Batch, pictures: Sequence[Tensor], photos: Sequence[Tensor]
    ) -> tuple[list[Tensor], list[Tensor]]:
        """The pixels that say something about the block; the background where it must stay clear."""
        shown, wanted, regions = [], [], self._regions(self._run.active.geometry.block)
        for sample, picture, photo in zip(batch.samples, pictures, photos, strict=True):
            crop, region = regions[sample.view.index]
            region = region[sample.crop.within(crop).slices][..., None]
            counts, clear = (region > 0).to(picture), (region == CLEAR).to(photo.device)
            target = torch.where(clear, sample.background.to(photo), photo)
            shown.append(picture * counts)
            wanted.append(target * counts)
        return shown, wanted

    def _plan(self) -> None:
        """One visit to every block that owns a pixel, weighed by the views that say something about it."""
        state = self._run.state
        for block in range(self._run.blocks):
            regions = self._regions(block)
            owns = any(OWN in region for _, region in regions.values())
            state.views[block] = len(regions) if owns else 0
        state.queue = list(plan_epoch(0, state.views, 1, self._run.config.seed))
        if not state.queue:
            raise NothingSeenError("no training view sees any Gaussian: check the poses and the points")

    def _regions(self, block: int) -> dict[int, Region]:
        """By view that says something about the block, what its pixels are to it; kept for one block."""
        if self._looked_at[0] == block:
            return self._looked_at[1]
        run, box, found = self._run, self._box(block), {}
        self._looked_at = block, found  # lets go of the last one's
        self._depths = self._depths or surface_depths(run)
        begun = self._joined(block).gaussians.to(run.device)
        for view, crop in footprints(begun, block, run.views.values(), run.rasterizer).crops.items():
            kinds = pixel_kinds(self._depths[view], run.views[view], box)[crop.slices].to(run.device)
            if bool(kinds.any()):
                found[view] = crop, kinds
        return found

    def _box(self, block: int) -> Box:
        means = self._scene.stored(initial_of(block)).means
        return enlarged(self._scene.tree.cell(block), means, self._run.config.recipe.overlap)

    def _joined(self, block: int) -> BlockState:
        """The block as it begins: its own, and as many of the others in its enlarged cell as have room."""
        box, others = self._box(block), [b for b in range(self._run.blocks) if b != block]
        own, *around = [self._scene.stored(initial_of(b)) for b in [block, *others]]
        joined = join([BlockState.fresh(g) for g in [own, *(g[box.contains(g.means)] for g in around)]])
        room = (self._run.config.limits.sole_limit or len(joined)) - len(own)
        more = evenly(range(len(own), len(joined)), max(room, 0))
        return joined[torch.tensor([*range(len(own)), *more])]


def independent_trainer(run: TrainingRun) -> Coordinator:
    """Trains each block in one visit, alone: by a recipe with an overlap, without layers and migration."""
    return Coordinator(run, BlocksAlone(run))
