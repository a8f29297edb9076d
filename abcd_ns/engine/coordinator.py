"""Block coordinate descent: visits blocks one after the other and trains each within its surroundings.

The optimisation loop belongs to the caller (nerfstudio's trainer, or `training_loop`): it asks for a
sample, renders it, steps its optimizers, and reports back. The coordinator decides what is trained, keeps
everything else at rest in the store, and tells its listeners what happens.
"""

import math
import random
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.batch import Batch, Rendered, Sample, background
from abcd_ns.engine.block_state import BlockState, Clocks
from abcd_ns.engine.compositing import sandwich
from abcd_ns.engine.config import TrainingConfig, resolve_ownership
from abcd_ns.engine.density import DensityClock, DensityControl
from abcd_ns.engine.events import Announcer, LayersDrawn, StepTaken, SweepEnded, VisitBegan, VisitEnded
from abcd_ns.engine.loss import photometric_loss, ssim_windows
from abcd_ns.engine.painter import Painter, PaintSettings, default_pass
from abcd_ns.engine.param_swap import Optimizers, Pace, Params, attach, detach, live_gaussians
from abcd_ns.engine.rasterizer import Rasterizer, Shot
from abcd_ns.engine.run_state import UNLIMITED, ActiveVisit, Budget, RunState, Stopwatch
from abcd_ns.engine.scaffold import WHOLE, join, part
from abcd_ns.engine.scene import StoredScene
from abcd_ns.engine.schedule import (
    VisitPlan,
    endless_order,
    exponential_decay,
    passes_of_sweep,
    plan_sweep,
    sh_degree_at,
    view_order,
    views_per_visit,
    visit_views,
)
from abcd_ns.engine.settle import has_reserve, settle
from abcd_ns.engine.storage import LayerCache
from abcd_ns.engine.types import View
from abcd_ns.engine.visit import VisitGeometry, VisitLayers, survey

DEFAULT_BATCH = 4
"""Views in a step where there are several blocks."""


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
        self._pace = Pace(optimizers)
        self._growth: dict[str, Tensor] = {}
        self._clocks = Clocks()
        self._layers: VisitLayers | None = None
        self._order: tuple[int, ...] = ()
        self._owner = torch.zeros(0, dtype=torch.int64)

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
        decay = exponential_decay(self.progress, 1.0, self.config.means_lr_decay)
        self._pace.set(1 if active.is_whole else self.batch, means_decay=decay)
        samples = enumerate(self._next_views(active))
        return Batch(self.state.step, tuple(self._sample(view, place) for place, view in samples))

    def _next_views(self, active: ActiveVisit) -> tuple[int, ...]:
        if active.is_whole:
            return (endless_order(active.views, active.done, self.config.seed),)
        return self._order[active.done * self.batch : (active.done + 1) * self.batch]

    def _sample(self, view: int, place: int) -> Sample:
        around = self._layers.around(view) if self._layers else None
        return Sample(
            view=self.views[view],
            crop=self._active.geometry.crops[view],
            layers=around and around.layers,
            near=around and around.near,
            window=around and around.window,
            background=background(self.config, self.state.step, place).to(self.device),
        )

    def render(self, batch: Batch) -> Rendered:
        """Draw the active block between its layers; differentiable in the live parameters."""
        changes = self._active.is_whole or self.config.sh_restart
        rasters = self._rasterizer.draw(
            live_gaussians(self.params),
            [
                Shot(sample.view, sample.crop, sample.near, None if sample.near is None else sample.window)
                for sample in batch.samples
            ],
            sh_degree=self.sh_degree if changes else self._active.sh_degree,
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
                pixel_loss=self.config.pixel_loss,
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
        if not active.is_whole:
            self._clocks = replace(self._clocks, steps=self._clocks.steps + taken)
            self._refine(rendered, taken)
        self.announce(StepTaken(self.state.step, active.number, active.done, psnr))
        if (
            active.done >= active.steps
            or self.finished
            or (active.is_whole and self.progress >= self.config.warmup)
        ):
            self._end_visit()

    def _refine(self, rendered: Rendered, taken: int) -> None:
        clock = self._density_clock(taken)
        self._growth = self.density.after_step(
            self.params, self.optimizers, self._growth, rendered.infos, clock
        )

    def _density_clock(self, taken: int) -> DensityClock:
        limit = self.config.density.limit
        return DensityClock(
            progress=self.progress,
            steps=self._clocks.steps,
            taken=taken,
            views=len(self._active.geometry.views),
            room=None if limit is None else limit - self.count(),
            seed=random.Random(f"density {self.config.seed} {self.state.step}").getrandbits(62),
        )

    # -- at rest -------------------------------------------------------------------------------------

    def count(self) -> int:
        """Gaussians in the whole scene, the live block included."""
        return sum(self.scene.count(block) for block in range(self.scene.tree.num_blocks))

    @property
    def sh_degree(self) -> int:
        """The degree of spherical harmonics in use."""
        active = self.state.active
        share = active.done / active.steps if self.config.sh_restart and active else self.progress
        return sh_degree_at(share, self.config.sh_ramp, self.config.sh_degree)

    def save(self, pin: str | None = None) -> None:
        """Commit everything, the live block in the middle of its visit included.

        Args:
            pin: keep this state under a name until it is unpinned.
        """
        updates = {}
        if (active := self.state.active) is not None:
            block, state = active.geometry.block, self._detached()
            held = part(state, self._owner) if active.is_whole else {block: state}
            updates = {block: state.to_tensors() for block, state in held.items()}
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

    @property
    def _active(self) -> ActiveVisit:
        if self.state.active is None:
            raise RuntimeError("no visit is under way: call next_batch first")
        return self.state.active

    def _begin_visit(self) -> None:
        began = self.stopwatch.seconds
        if self.state.visit == 0 and has_reserve(self.scene) and self.progress < self.config.warmup:
            self.state.active = self._scaffold_visit(began)
        else:
            self.state.active = self._block_visit(began)
        self.state.visit += 1
        self._attach(self.state.active)

    def _scaffold_visit(self, began: float) -> ActiveVisit:
        geometry = VisitGeometry(WHOLE, {index: view.full for index, view in self.views.items()}, None)
        steps = UNLIMITED if self.budget.steps is None else math.ceil(self.budget.steps * self.config.warmup)
        return ActiveVisit(0, geometry, self.sh_degree, steps, geometry.views, began=began)

    def _block_visit(self, began: float) -> ActiveVisit:
        plan, geometry = self._next_visit()
        earlier = BlockState.from_tensors(*self.scene.store.load(plan.block)).clocks.visits
        used = self._views_used(len(geometry.views))
        return ActiveVisit(
            number=self.state.visit,
            geometry=geometry,
            sh_degree=self.config.sh_degree if self.config.sh_restart else self.sh_degree,
            steps=plan.steps,
            views=visit_views(geometry.views, used, earlier, self.config.seed),
            began=began,
        )

    def _next_visit(self) -> tuple[VisitPlan, VisitGeometry]:
        """The next block that some view sees; blocks that none sees any more are passed over."""
        while True:
            plan = self._next_plan()
            geometry = self._survey(plan.block, window=self._uses_windows)
            self.state.views[plan.block] = len(geometry.views)
            if geometry.views:
                return plan, geometry

    def _attach(self, active: ActiveVisit) -> None:
        blocks = range(self.scene.tree.num_blocks) if active.is_whole else [active.geometry.block]
        states = [BlockState.from_tensors(*self.scene.store.load(block)) for block in blocks]
        rows = torch.tensor([len(state) for state in states])
        self._owner = torch.tensor(list(blocks)).repeat_interleave(rows).to(self.device)
        rest = join(states).to(self.device)
        if active.done == 0 and not self.config.keep_moments:
            rest = rest.forgetful()
        attach(rest, self.params, self.optimizers)
        self._growth, self._clocks = dict(rest.growth), rest.clocks
        self.scene.lay_over(
            None if active.is_whole else active.geometry.block, lambda: live_gaussians(self.params)
        )
        self._order = self._order_of(active)
        seen, block = len(active.geometry.views), None if active.is_whole else active.geometry.block
        self.announce(VisitBegan(active.number, self.state.sweep, block, active.steps, seen, len(rest)))
        before = self.stopwatch.seconds
        self._layers = self._draw_layers(active)
        active.layer_seconds += self.stopwatch.seconds - before

    def _order_of(self, active: ActiveVisit) -> tuple[int, ...]:
        taken = 0 if active.is_whole else active.steps * self.batch
        return view_order(active.views, taken, active.number, self.config.seed)

    def _draw_layers(self, active: ActiveVisit) -> VisitLayers | None:
        if active.is_whole or self.scene.tree.num_blocks == 1 or not self.config.layers:
            return None
        painter = Painter(
            self.scene,
            list(self.views.values()),
            self._rasterizer,
            ownership=self._ownership,
            pass_gaussians=self.config.pass_gaussians or default_pass(self.scene),
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
        self._clocks = replace(self._clocks, visits=self._clocks.visits + (not active.is_whole))
        state = self._detached()
        updates = settle(self.scene, active.geometry.block, state, self.config.migrate)
        self.scene.lift()
        self.state.active, self._layers = None, None
        self.state.seconds = self.stopwatch.seconds
        self.scene.store.commit({b: s.to_tensors() for b, s in updates.items()}, state=self.state.to_json())
        block = None if active.is_whole else active.geometry.block
        staying = len(state) if block is None else len(updates[block])
        self.announce(
            VisitEnded(
                active.number,
                self.state.sweep,
                block,
                gaussians=staying,
                migrated=len(state) - staying,
                layer_seconds=active.layer_seconds,
                seconds=self.stopwatch.seconds - active.began,
            )
        )
        if not active.is_whole and not self.state.queue:
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
            steps = (passes / self.batch, remaining, config.seed, config.visit_steps)
            state.queue = list(plan_sweep(state.sweep, used, *steps))
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
            self._rasterizer,
            cell=self.scene.tree.cell(block) if window else None,
            percentile=self.config.window_percentile,
        )

    def _detached(self) -> BlockState:
        return detach(self.params, self.optimizers, self._growth, self._clocks)
