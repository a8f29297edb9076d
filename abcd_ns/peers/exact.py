"""Exact joint training over blocks, one block on the device at a time: the reference for gradients.

NeRF-XL (Li et al., ECCV 2024) shows that volume rendering, and so its gradient, parts exactly over cells that
tile space. In every step:

1. every block's layer of the step's views is drawn, without gradients, and all are folded to the picture;
2. the loss gives G = dL/dC, and every layer is drawn again, with gradients, between its own F and B:
   dL/dC_A = T_F G and dL/dT_A = T_F <G, C_B + T_B b>; what a Gaussian gets from several cells is added up;
3. every block's optimizers step.

By fragments the picture is the merged one, so this is 3DGS step for step, but for the 1e-4 of light at which
drawing stops. The device holds one block at a time and what reaches into its cell, and the step's layers; all
blocks with moments and gradients lie in RAM.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from abcd_ns.engine.events import PhotosWanted, StepTaken
from abcd_ns.engine.gaussians.block_state import BlockState, join
from abcd_ns.engine.gaussians.param_swap import Pace, attach, detach
from abcd_ns.engine.layers.compositing import composite, fold, sandwich
from abcd_ns.engine.render import Raster, Shot
from abcd_ns.engine.render.base import SUMS
from abcd_ns.engine.render.pictures import seen_behind
from abcd_ns.engine.space.intervals import ray_interval
from abcd_ns.engine.space.tree import front_to_back
from abcd_ns.engine.space.visibility import Optics
from abcd_ns.engine.store.coarse_model import split_by_block
from abcd_ns.engine.train.density.control import DensityClock
from abcd_ns.engine.train.density.growing import Judged
from abcd_ns.engine.train.planner import NothingSeenError
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.schedule import endless_order, exponential_decay, views_per_step
from abcd_ns.engine.train.step.batch import (
    COMING,
    Batch,
    Pictures,
    Rendered,
    Sample,
    background,
    part_to_draw,
)
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.types import PARAM_NAMES, Gaussians, Layer


@dataclass
class Gradients:
    """What a step adds up over cells, in RAM, for all n Gaussians of the scene."""

    params: dict[str, Tensor]  # by parameter, of its shape
    sums: Float[Tensor, "v n 10"]  # by view, see ResidualSums; density control judges by it


class ExactTrainer(Trainer):
    """Every step trains all blocks: `render` gives pictures whose gradient the caller's backward takes, and
    `after_step` passes it to blocks. Between steps the run's parameters are empty."""

    def __init__(self, run: TrainingRun) -> None:
        super().__init__(run)
        self._pace = Pace(run.optimizers, run.config.recipe.fast_start)
        self._reach = run.reach(run.views)
        self._batch: Batch | None = None
        self._degree = 0
        self._layers_of: list[dict[int, Layer]] = []
        self._residuals: list[Float[Tensor, "_h _w 3"]] = []
        self._pictures: list[Tensor] = []
        self._take()
        self.scene.set_active(None, lambda: self._all.gaussians)

    @property
    def batch(self) -> int:
        return views_per_step(self.config.batch, 1)

    def next_batch(self) -> Batch:
        """Set the learning rate and say what to train on next: whole views, or random parts. A
        NothingSeenError if no Gaussian is left."""
        if not len(self._all):
            low = "--pipeline.training.density.cull-alpha-thresh"
            raise NothingSeenError(f"no Gaussian is left: set {low} lower, and min-contribution")
        self.stopwatch.start()
        decay = exponential_decay(self.progress, self.config.recipe.means_lr_decay) * self._reach
        self._pace.set(self.batch, self.state.step * self.batch, decay)
        step, views = self.state.step, self.run.views_at(self.run.reduction)
        rows, samples, first = tuple(sorted(views)), [], step * self.batch
        order = [endless_order(rows, first + k, self.config.seed) for k in range(self.batch + COMING)]
        self.announce(PhotosWanted(tuple(order)))
        for place, view in enumerate(views[row] for row in order[: self.batch]):
            behind = background(self.config, step, place).to(self.device, view.viewmat.dtype)
            crop = part_to_draw(self.config, view.full, step, place)
            share = crop.pixels / view.full.pixels
            samples.append(Sample(view, crop, None, None, behind, share))
        return Batch(tuple(samples))

    def render(self, batch: Batch) -> Rendered:
        """Pass 1: all blocks' layers, folded; differentiable in the pictures alone."""
        self._batch, self._layers_of = batch, [{} for _ in batch.samples]
        self._degree = self.run.sh_degree
        with torch.no_grad():
            for block, _, gaussians in self._cells():
                for place in range(len(batch.samples)):
                    self._layers_of[place][block] = self._draw(block, gaussians, place).layer
        wholes = [fold(self._in_order(place)) for place in range(len(batch.samples))]
        pairs = zip(wholes, batch.samples, strict=True)
        self._pictures = [composite(whole, sample.background).requires_grad_() for whole, sample in pairs]
        return Rendered(tuple(picture.clamp(0, 1) for picture in self._pictures), tuple(wholes), ())

    def loss(self, batch: Batch, pictures: Pictures, photos: Pictures) -> Float[Tensor, ""]:
        """Photometric, the mean of the samples'; what the density strategy asks for is added by block."""
        pairs = zip(pictures, photos, strict=True)
        self._residuals = [photo[..., :3] - picture.detach() for picture, photo in pairs]
        return batch.loss(pictures, photos, self.config)

    def after_step(self, rendered: Rendered, errors: Sequence[Tensor] = ()) -> None:  # noqa: ARG002
        """Pass 2, and a step of every block's optimizers."""
        gradients, taken = self.gradients(), len(self._batch.samples)
        self.state.step += 1
        owner = self._owner_of_all()
        updated, rows = [], []
        for block in owner.unique().tolist():
            rows.append((owner == block).nonzero()[:, 0])
            updated.append(self._step(self._all[rows[-1]], gradients, rows[-1], taken))
        joined, order = join(updated), torch.cat(rows)
        kept = all(len(state) == len(row) for state, row in zip(updated, rows, strict=True))
        self._all = joined[order.argsort()] if kept else joined
        self._pictures, self._layers_of = [], []
        _, psnr = self.health.end_step(errors)
        self.announce(StepTaken(self.state.step, 0, self.state.step, psnr))
        if self.finished:
            self.save()
        elif self.scene.is_due(self.config.commit_seconds):
            self.persist(self.config.commit_seconds)

    def gradients(self) -> Gradients:
        """Pass 2: every layer again, between its F and B, with the gradient that the pictures were given."""
        everything, views = self._all.gaussians, len(self._pictures)
        params = {name: torch.zeros_like(value) for name, value in everything.items()}
        sums = everything.means.new_zeros(views, len(everything), SUMS)
        for block, rows, gaussians in self._cells():
            leaves = Gaussians(**{name: v.detach().requires_grad_() for name, v in gaussians.items()})
            for place in range(views):
                found = self._backward(block, place, self._draw(block, leaves, place))
                if found is not None:
                    sums[place].index_add_(0, rows, found.to(sums))
            for name, leaf in leaves.items():
                if leaf.grad is not None:
                    params[name].index_add_(0, rows, leaf.grad.to("cpu"))
        return Gradients(params, sums)

    def count(self) -> int:
        return len(self._all)

    def persist(self, within: float) -> None:
        """Persist every block; there are no visits."""
        held, nobody = split_by_block(self._all, self._owner_of_all()), self._all.nobody
        blocks = range(self.scene.tree.num_blocks)
        self.run.persist(self.scene.tree, {block: held.get(block, nobody) for block in blocks}, within)

    def restore(self) -> None:
        """As the base's, the order of the Gaussians aside."""
        self.run.restore()
        self._take()

    def _take(self) -> None:
        self._all = join([self.scene.state(block) for block in range(self.scene.tree.num_blocks)])

    def _owner_of_all(self) -> Int64[Tensor, "n"]:
        return self.scene.tree.assign(self._all.gaussians.means)

    def _cells(self) -> Iterator[tuple[int, Int64[Tensor, "m"], Gaussians]]:
        """(block, rows, Gaussians on the device) of every layer that holds any."""
        everything, tree = self._all.gaussians, self.scene.tree
        optics = Optics([sample.view for sample in self._batch.samples], self.run.rasterizer.slack)
        owner = self._owner_of_all()
        for block in range(tree.num_blocks):
            reached = optics.reaches(everything.means, everything.scales, tree.cell(block))
            rows = ((owner == block) | reached).nonzero()[:, 0]
            if len(rows):
                yield block, rows, everything[rows].to(self.device)

    def _draw(self, block: int, gaussians: Gaussians, place: int) -> Raster:
        sample = self._batch.samples[place]
        grid = self.run.rasterizer.window_grid(sample.crop)
        window = ray_interval(self.scene.tree.cell(block), sample.view, grid, self.device)
        shot = Shot(sample.view, sample.crop, None, window)
        options = {"antialiased": self.config.antialiased, "residual_sums": self._asks}
        return self.run.rasterizer.draw(gaussians, [shot], sh_degree=self._degree, **options)[0]

    def _in_order(self, place: int) -> list[Layer]:
        """The view's layers, front to back."""
        order = front_to_back(self.scene.tree, self._batch.samples[place].view.center.double().cpu())
        layers = self._layers_of[place]
        return [layers[block] for block in order if block in layers]

    def _backward(self, block: int, place: int, raster: Raster) -> Float[Tensor, "m 10"] | None:
        """Backward through one drawing; gives what density control judges by, if anything."""
        layers, own = self._in_order(place), self._layers_of[place][block]
        at = next(k for k, layer in enumerate(layers) if layer is own)
        front, back = fold(layers[:at], like=own), fold(layers[at + 1 :], like=own)
        sums = raster.info.get("sums")
        if sums is not None:
            sums.ask([seen_behind(self._residuals[place], front.transmittance)])
        picture = sandwich(front, raster.layer, back, self._batch.samples[place].background)
        picture.backward(self._pictures[place].grad)
        return None if sums is None or sums.values is None else sums.values[0]

    def _step(
        self, state: BlockState, gradients: Gradients, rows: Int64[Tensor, "m"], taken: int
    ) -> BlockState:
        attach(state.to(self.device), self.params, self.optimizers, batch=taken)
        for name in PARAM_NAMES:
            self.params[name].grad = gradients.params[name][rows].to(self.device)
        for optimizer in self.optimizers.values():
            optimizer.step()
        steps, views = state.clocks.steps + taken, state.clocks.adam_views + taken
        clocks = replace(state.clocks, steps=steps, adam_views=views)
        limit, everything = self.config.density.limit, max(self.count(), 1)
        clock = DensityClock(
            progress=self.progress,
            steps=clocks.steps,
            taken=taken,
            views=len(self.views),
            refined=clocks.refined,
            room=None if limit is None else max(limit - everything, 0) * len(state) // everything,
        )
        growth = {name: value.to(self.device) for name, value in state.growth.items()}
        judged = self._judged(gradients.sums[:, rows])
        growth = self.run.density.gather(self.params, growth, (), judged, clock.views)
        growth, refined = self.run.density.after_step(self.params, self.optimizers, growth, clock)
        if refined:
            clocks = replace(clocks, refined=clock.steps)
        stepped = detach(self.params, self.optimizers, growth, clocks)
        attach(stepped[:0].to(self.device), self.params, self.optimizers)
        return stepped

    @property
    def _asks(self) -> bool:
        return self.run.density.asks(self.progress, first=False)

    def _judged(self, sums: Float[Tensor, "v m 10"]) -> list[Judged]:
        """What a step's pictures say of one block's Gaussians."""
        if not self._asks:
            return []
        return [
            Judged(sample.view, own.to(self.device), residual.square().sum(dim=-1).mean(), sample.share)
            for sample, own, residual in zip(self._batch.samples, sums, self._residuals, strict=True)
        ]
