"""Block coordinate descent: visits blocks one after the other and trains each within its surroundings.

The optimisation loop belongs to the caller (nerfstudio's trainer, or `training_loop`): it asks for a
sample, renders it, steps its optimizers, and reports back. The coordinator decides what is trained, keeps
everything else at rest in the store, and tells its listeners what happens.
"""

import random
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.block_state import BlockState, Clocks
from abcd_ns.engine.blocks import BlockTree
from abcd_ns.engine.compositing import sandwich
from abcd_ns.engine.config import TrainingConfig, resolve_ownership
from abcd_ns.engine.density import DensityClock, DensityControl
from abcd_ns.engine.events import Announcer, LayersDrawn, StepTaken, SweepEnded, VisitBegan, VisitEnded
from abcd_ns.engine.loss import photometric_loss, ssim_windows
from abcd_ns.engine.painter import Painter, PaintSettings, Parts
from abcd_ns.engine.param_swap import (
    Optimizers,
    Params,
    attach,
    detach,
    live_gaussians,
    scale_to_batch,
)
from abcd_ns.engine.rasterizer import Rasterizer, Shot, ZWindow
from abcd_ns.engine.rasterizer.projection import Splats
from abcd_ns.engine.run_state import ActiveVisit, Budget, RunState, Stopwatch
from abcd_ns.engine.scene import StoredScene
from abcd_ns.engine.schedule import (
    VisitPlan,
    exponential_decay,
    passes_of_sweep,
    plan_sweep,
    sh_degree_at,
    view_order,
    views_per_visit,
    visit_views,
)
from abcd_ns.engine.storage import LayerCache
from abcd_ns.engine.types import Crop, Gaussians, View
from abcd_ns.engine.visit import VisitGeometry, VisitLayers, survey

DEFAULT_BATCH = 4
"""Views in a step where there are several blocks."""


@dataclass(frozen=True)
class Sample:
    """One view that a step trains on."""

    view: View
    crop: Crop
    layers: Parts | None
    near: Splats | None
    window: ZWindow | None
    background: Float[Tensor, "3"]


@dataclass(frozen=True)
class Batch:
    """What one step trains on."""

    step: int
    samples: tuple[Sample, ...]


@dataclass(frozen=True)
class Rendered:
    """The active block within its surroundings, as a batch shows it."""

    pictures: tuple[Float[Tensor, "_h _w 3"], ...]
    """Of each sample's crop, background included, 0..1."""
    transmittances: tuple[Float[Tensor, "_h _w"], ...]
    """Of the active block and what was sorted in with it."""
    infos: tuple[dict[str, Any], ...]


class Coordinator:
    """Runs ABCD over a scene at rest in `store`, through the caller's live parameters and optimizers.

    Args:
        views: the training views; `View.index` names them.
        params, optimizers: as `param_swap` wants them. Their present content is dropped, but for the
            learning rates; that of the means is the one to decay from.
        scene_key: fingerprint of the capture, part of every layer's key.
    """

    def __init__(
        self,
        config: TrainingConfig,
        budget: Budget,
        scene: StoredScene,
        views: list[View],
        cache: LayerCache,
        rasterizer: Rasterizer,
        params: Params,
        optimizers: Optimizers,
        *,
        scene_key: str = "",
        device: torch.device | str = "cpu",
    ) -> None:
        self.config, self.budget, self.scene, self.cache = config, budget, scene, cache
        self.params, self.optimizers = params, optimizers
        self.views = {view.index: view.to(device) for view in views}
        self.device = torch.device(device)
        self.announce = Announcer()
        self.stopwatch = Stopwatch()
        self.density = DensityControl(config.density)
        self.state = RunState()
        self._scene_key = scene_key
        self._rasterizer = rasterizer
        self._ownership = resolve_ownership(config.ownership, rasterizer)
        self.batch = config.batch or (1 if scene.tree.num_blocks == 1 else DEFAULT_BATCH)
        scale_to_batch(optimizers, self.batch)
        self._means_lr: float = optimizers["means"].param_groups[0]["lr"]
        self._growth: dict[str, Tensor] = {}
        self._clocks = Clocks()
        self._layers: VisitLayers | None = None
        self._order: tuple[int, ...] = ()

    # -- the loop ------------------------------------------------------------------------------------

    @property
    def progress(self) -> float:
        """Share of the run that is done, 0..1."""
        return self.budget.progress(self.state.step, self.stopwatch.seconds)

    @property
    def finished(self) -> bool:
        """Whether the budget is used up."""
        return self.progress >= 1.0

    def next_batch(self) -> Batch:
        """Begin a visit if none is under way, set the learning rate, and say what to train on next.

        Raises:
            RuntimeError: no view sees any block.
        """
        self.stopwatch.start()
        if self.state.active is None:
            self._begin_visit()
        active = self._active
        rate = exponential_decay(self.progress, self._means_lr, self._means_lr * self.config.means_lr_decay)
        self.optimizers["means"].param_groups[0]["lr"] = rate
        views = self._order[active.done * self.batch : (active.done + 1) * self.batch]
        return Batch(self.state.step, tuple(self._sample(view, place) for place, view in enumerate(views)))

    def _sample(self, view: int, place: int) -> Sample:
        around = self._layers.around(view) if self._layers else None
        return Sample(
            view=self.views[view],
            crop=self._active.geometry.crops[view],
            layers=around and around.layers,
            near=around and around.near,
            window=around and around.window,
            background=self._background(place),
        )

    def render(self, batch: Batch) -> Rendered:
        """Draw the active block between its layers; differentiable in the live parameters."""
        rasters = self._rasterizer.draw(
            live_gaussians(self.params),
            [
                Shot(sample.view, sample.crop, sample.near, None if sample.near is None else sample.window)
                for sample in batch.samples
            ],
            sh_degree=self._active.sh_degree,
            antialiased=self.config.antialiased,
            absgrad=self.density.absgrad,
        )
        infos = tuple({id(raster.info): raster.info for raster in rasters}.values())
        self.density.before_backward(infos)
        pictures = []
        for sample, raster in zip(batch.samples, rasters, strict=True):
            if sample.layers is None:
                rgb = raster.color + raster.transmittance[..., None] * sample.background
            else:
                rgb = sandwich(sample.layers.front, raster.layer, sample.layers.back, sample.background)
            pictures.append(rgb.clamp(0, 1))
        return Rendered(tuple(pictures), tuple(raster.transmittance for raster in rasters), infos)

    def loss(
        self,
        batch: Batch,
        pictures: Sequence[Float[Tensor, "_h _w 3"]],
        photos: Sequence[Float[Tensor, "_h _w 3"]],
    ) -> Float[Tensor, ""]:
        """The loss of a step: photometric over the crops, the mean of the samples', plus what the density
        strategy asks for."""
        total = torch.zeros((), device=self.device)
        for sample, picture, photo in zip(batch.samples, pictures, photos, strict=True):
            view = sample.view
            total = total + photometric_loss(
                picture,
                photo,
                full_pixels=view.width * view.height,
                full_windows=ssim_windows(view.height, view.width),
                ssim_lambda=self.config.ssim_lambda,
            )
        photometric = total / len(batch.samples)
        if self.config.density.strategy != "mcmc":
            return photometric
        return photometric + self.density.regularisation(self.params, self.count())

    def after_step(self, rendered: Rendered, psnr: float = float("nan")) -> None:
        """Call after the optimizers stepped: grows and prunes, and ends the visit when its steps are done."""
        active, taken = self._active, len(rendered.pictures)
        self.state.step += 1
        active.done += 1
        self._clocks = replace(self._clocks, steps=self._clocks.steps + taken)
        limit = self.config.density.limit
        clock = DensityClock(
            progress=self.progress,
            steps=self._clocks.steps,
            taken=taken,
            views=len(active.geometry.views),
            room=None if limit is None else limit - self.count(),
            seed=random.Random(f"density {self.config.seed} {self.state.step}").getrandbits(62),
        )
        self._growth = self.density.after_step(
            self.params, self.optimizers, self._growth, rendered.infos, clock
        )
        self.announce(StepTaken(self.state.step, active.number, active.done, psnr))
        if active.done >= active.steps or self.finished:
            self._end_visit()

    # -- at rest -------------------------------------------------------------------------------------

    def count(self) -> int:
        """Gaussians in the whole scene, the live block included."""
        return sum(self.scene.count(block) for block in range(self.scene.tree.num_blocks))

    @property
    def sh_degree(self) -> int:
        """The degree of spherical harmonics in use."""
        return sh_degree_at(self.progress, self.config.sh_ramp, self.config.sh_degree)

    def save(self, pin: str | None = None) -> None:
        """Commit everything, the live block in the middle of its visit included.

        Args:
            pin: keep this state under a name until it is unpinned.
        """
        updates = {}
        if self.state.active is not None:
            updates[self.state.active.geometry.block] = self._detached().to_tensors()
        self.state.seconds = self.stopwatch.seconds
        self.scene.store.commit(updates, state=self.state.to_json())
        if pin is not None:
            self.scene.store.pin(pin)

    def restore(self) -> None:
        """Go on from what the store holds: exactly where `save` was called."""
        self.state = RunState.from_json(self.scene.store.state)
        self.stopwatch = Stopwatch(self.state.seconds)
        if self.state.active is not None:
            self._attach(self.state.active)

    # -- visits --------------------------------------------------------------------------------------

    @property
    def _active(self) -> ActiveVisit:
        if self.state.active is None:
            raise RuntimeError("no visit is under way: call next_batch first")
        return self.state.active

    def _begin_visit(self) -> None:
        began = self.stopwatch.seconds
        plan, geometry = self._next_visit()
        earlier = BlockState.from_tensors(*self.scene.store.load(plan.block)).clocks.visits
        used = self._views_used(len(geometry.views))
        self.state.active = ActiveVisit(
            number=self.state.visit,
            geometry=geometry,
            sh_degree=self.sh_degree,
            steps=plan.steps,
            views=visit_views(geometry.views, used, earlier, self.config.seed),
            began=began,
        )
        self.state.visit += 1
        self._attach(self.state.active)

    def _next_visit(self) -> tuple[VisitPlan, VisitGeometry]:
        """The next block that some view sees; blocks that none sees any more are passed over."""
        while True:
            plan = self._next_plan()
            geometry = self._survey(plan.block, window=self._uses_windows)
            self.state.views[plan.block] = len(geometry.views)
            if geometry.views:
                return plan, geometry

    def _attach(self, active: ActiveVisit) -> None:
        block = active.geometry.block
        rest = BlockState.from_tensors(*self.scene.store.load(block)).to(self.device)
        attach(rest, self.params, self.optimizers)
        self._growth, self._clocks = dict(rest.growth), rest.clocks
        self.scene.lay_over(block, lambda: live_gaussians(self.params))
        self._order = view_order(active.views, active.steps * self.batch, active.number, self.config.seed)
        seen = len(active.geometry.views)
        self.announce(VisitBegan(active.number, self.state.sweep, block, active.steps, seen, len(rest)))
        before = self.stopwatch.seconds
        self._layers = self._draw_layers(active)
        active.layer_seconds += self.stopwatch.seconds - before

    def _draw_layers(self, active: ActiveVisit) -> VisitLayers | None:
        if self.scene.tree.num_blocks == 1 or not self.config.layers:
            return None
        painter = Painter(
            self.scene,
            list(self.views.values()),
            self._rasterizer,
            ownership=self._ownership,
            pass_gaussians=self.config.pass_gaussians or self._default_pass(),
            device=self.device,
        )
        settings = PaintSettings(active.sh_degree, self.config.antialiased)
        layers = VisitLayers(painter, self.cache, active.geometry, self.views, settings, self._scene_key)
        wanted = dict.fromkeys(self._order[active.done * self.batch :])
        for done, _ in enumerate(layers.draw(wanted), start=1):
            self.announce(LayersDrawn(active.number, done, len(wanted)))
        return layers

    def _end_visit(self) -> None:
        active = self._active
        block = active.geometry.block
        self._clocks = replace(self._clocks, visits=self._clocks.visits + 1)
        state = self._detached()
        owner = self.scene.tree.assign(state.gaussians.means.cpu()).to(self.device)
        updates = {block: state[owner == block]}
        for target in owner.unique().tolist():
            if target != block:
                rest = BlockState.from_tensors(*self.scene.store.load(target)).to(self.device)
                updates[target] = rest.joined_by(state[owner == target])
        self.scene.lift()
        self.state.active, self._layers = None, None
        self.state.seconds = self.stopwatch.seconds
        self.scene.store.commit({b: s.to_tensors() for b, s in updates.items()}, state=self.state.to_json())
        self.announce(
            VisitEnded(
                active.number,
                self.state.sweep,
                block,
                gaussians=len(updates[block]),
                migrated=len(state) - len(updates[block]),
                layer_seconds=active.layer_seconds,
                seconds=self.stopwatch.seconds - active.began,
            )
        )
        if not self.state.queue:
            self.announce(SweepEnded(self.state.sweep, self.state.step))

    def _next_plan(self) -> VisitPlan:
        state, config = self.state, self.config
        if not state.queue:
            if not state.views:
                blocks = range(self.scene.tree.num_blocks)
                state.views = {b: len(self._survey(b, window=False).views) for b in blocks}
            else:
                state.sweep += 1
            remaining = None if self.budget.steps is None else self.budget.steps - state.step
            passes = passes_of_sweep(state.sweep, config.first_passes, config.last_passes)
            used = {block: self._views_used(seen) for block, seen in state.views.items()}
            state.queue = list(plan_sweep(state.sweep, used, passes / self.batch, remaining, config.seed))
            if not state.queue:
                raise RuntimeError("no training view sees any Gaussian: check the poses and the points")
        return state.queue.pop(0)

    def _views_used(self, seen: int) -> int:
        """Of the views that see a block, how many a visit uses."""
        most = max(self.state.views.values())
        return views_per_visit(seen, most, self.config.visit_views) if most else 0

    @property
    def _uses_windows(self) -> bool:
        fragments = self._ownership == "fragments" and self.scene.tree.num_blocks > 1
        return self.config.layers and fragments

    def _survey(self, block: int, window: bool) -> VisitGeometry:
        return survey(
            self.scene.gaussians(block).to(self.device),
            block,
            self.views.values(),
            cell=self.scene.tree.cell(block) if window else None,
            percentile=self.config.window_percentile,
        )

    def _detached(self) -> BlockState:
        return detach(self.params, self.optimizers, self._growth, self._clocks)

    def _default_pass(self) -> int:
        counts = [self.scene.count(block) for block in range(self.scene.tree.num_blocks)]
        return max(2 * max(counts), 200_000)

    def _background(self, place: int) -> Tensor:
        if self.config.background == "random":
            drawn = random.Random(f"background {self.config.seed} {self.state.step} {place}").getrandbits(62)
            generator = torch.Generator().manual_seed(drawn)
            return torch.rand(3, generator=generator).to(self.device)
        return torch.full((3,), float(self.config.background == "white"), device=self.device)


def blocks_at_rest(
    tree: BlockTree, gaussians: Gaussians
) -> dict[int, tuple[dict[str, Tensor], dict[str, Any]]]:
    """The first content of a store: `gaussians` parted by `tree`, nothing trained yet."""
    owner = tree.assign(gaussians.means)
    return {b: BlockState.fresh(gaussians[owner == b]).to_tensors() for b in range(tree.num_blocks)}
