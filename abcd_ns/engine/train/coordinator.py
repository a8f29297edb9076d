"""Block coordinate descent: visits blocks one after the other and trains each within its surroundings.

The optimisation loop belongs to the caller (nerfstudio's trainer, or `training_loop`): it asks for a
sample, renders it, steps its optimizers, and reports back. The coordinator decides what is trained, keeps
everything else at rest in the store, and tells its listeners what happens.
"""

import random
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from abcd_ns.engine.events import (
    Announcer,
    LayersDrawn,
    StepTaken,
    SweepEnded,
    VisitBegan,
    VisitEnded,
)
from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.gaussians.param_swap import Optimizers, Pace, Params, attach, detach, live_gaussians
from abcd_ns.engine.layers.layer_store import LAYER_BYTES, LayerStore
from abcd_ns.engine.layers.painter import Painter, PaintSettings, default_pass
from abcd_ns.engine.layers.visit_layers import VisitLayers
from abcd_ns.engine.render import Rasterizer
from abcd_ns.engine.space.influence import influence
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import crash_points
from abcd_ns.engine.store.scene import BlockScene, StoredScene
from abcd_ns.engine.store.settle import at_rest, count_at_rest, has_scaffold, settle
from abcd_ns.engine.store.special_blocks import LIVE
from abcd_ns.engine.train.batch import Backgrounds, Batch, Rendered, Sample
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityClock, DensityControl, Infos, added, for_blocks
from abcd_ns.engine.train.health.health import Health
from abcd_ns.engine.train.memory import check_room
from abcd_ns.engine.train.planner import Planner
from abcd_ns.engine.train.run_state import ActiveVisit, Budget, RunState, Stopwatch
from abcd_ns.engine.train.schedule import (
    endless_order,
    exponential_decay,
    sh_degree_at,
    view_order,
    views_of_member,
    views_per_step,
    views_per_warm_up_step,
)
from abcd_ns.engine.train.splitting import cut_full, is_full
from abcd_ns.engine.train.step_drawing import StepDrawing
from abcd_ns.engine.train.workers.crew import Crew
from abcd_ns.engine.train.workers.share import Target, Task
from abcd_ns.engine.types import View


class Coordinator(StepDrawing):
    """Runs ABCD over a scene at rest in `store`, through the caller's live parameters and optimizers.

    Args:
        views: the training views; `View.index` names them.
        params, optimizers: as `param_swap` wants them. Their present content is dropped, but for the
            learning rates; that of the means is the one to decay from.
        layer_bytes: what a visit may keep of layers on the device.
        layer_ram_bytes: and in RAM, of those that have no room there; see LayerStore.
        target: gives what a sample is trained on, so that helpers can share a step (see `crew`); None for
            one process.
    """

    def __init__(
        self,
        config: TrainingConfig,
        budget: Budget,
        scene: StoredScene,
        views: list[View],
        rasterizer: Rasterizer,
        params: Params,
        optimizers: Optimizers,
        *,
        device: torch.device | str = "cpu",
        layer_bytes: int = LAYER_BYTES,
        layer_ram_bytes: int = 0,
        target: Callable[[Sample], Target] | None = None,
    ) -> None:
        self.config, self.budget, self.scene = config, budget, scene
        self.params, self.optimizers = params, optimizers
        self.views = {view.index: view for view in views}  # on the CPU, whatever the device
        self.device = torch.device(device)
        self.announce = Announcer()
        self.stopwatch = Stopwatch()
        self.density = self._density_control()
        self.state = RunState()
        self._layer_room = layer_bytes, layer_ram_bytes
        self._rasterizer = rasterizer
        self._planner = Planner(config, budget, scene, self.views, rasterizer, device=self.device)
        self._pace = Pace(optimizers, config.recipe.batch_power)
        acts, drops = config.heal and config.recipe.layers, config.density.strategy == "default"
        self.health = Health(scene, params, optimizers, self.announce, may_act=acts, may_drop=drops)
        self._backgrounds = Backgrounds(config, self.device)
        self._growth: dict[str, Tensor] = {}
        self._clocks = Clocks()
        self._layers: VisitLayers | None = None
        self._order: tuple[int, ...] = ()
        self._target = target
        self._crew: Crew | None = None

    @property
    def batch(self) -> int:
        """Views in a step of the visit that is under way."""
        if self.state.active is not None and self.state.active.is_whole:
            return views_per_warm_up_step(self.config.batch, self.config.limits.batch_limit)
        return views_per_step(self.config.batch, self.scene.tree.num_blocks, self.config.limits.batch_limit)

    def _density_control(self) -> DensityControl:
        return DensityControl(for_blocks(self.config.density, self.scene.tree.num_blocks))

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
        self._pace.set(self.batch, means_decay=decay, damping=self.health.damping)
        if self._crew is not None:
            task = Task(active.done, self.state.step, self._degree_drawn)
            self._crew.begin(live_gaussians(self.params), task)
        samples = enumerate(self._views_of_step(active, self._order, active.done))
        step = self.state.step
        return Batch(step, tuple(self._sample(view, place, step) for place, view in samples))

    def _views_of_step(
        self, active: ActiveVisit, order: tuple[int, ...], done: int, member: int = 0
    ) -> tuple[int, ...]:
        each = self.batch // active.crew
        if not order:  # nobody knows how many steps there will be
            places = range(done * self.batch + member * each, done * self.batch + (member + 1) * each)
            return tuple(endless_order(active.views, place, self.config.seed) for place in places)
        return order[done * each : (done + 1) * each]

    def after_step(self, rendered: Rendered, psnrs: Sequence[Tensor] = ()) -> None:
        """Call after the optimizers stepped: grows and prunes, and ends the visit when its steps are done.

        Args:
            psnrs: of each picture, dB; listeners are told their mean.
        """
        active, taken = self._active, len(rendered.pictures) * self._active.crew
        self.state.step += 1
        active.done += 1
        sound, psnr = self.health.end_step(psnrs)
        self._clocks = replace(self._clocks, adam_views=self._clocks.adam_views + self.batch)
        if not active.is_whole:
            self._clocks = replace(self._clocks, steps=self._clocks.steps + taken)
            self._refine(rendered.infos if sound else (), taken)
        self.announce(StepTaken(self.state.step, active.number, active.done, psnr))
        is_warm = active.is_whole and self.progress >= self.config.warmup
        if active.done >= active.steps or self.finished or is_warm or self._has_outgrown(active):
            self._end_visit()
        elif self.scene.is_due(self.config.commit_seconds):
            self._rest_amid_visit(self.config.commit_seconds)

    def _has_outgrown(self, active: ActiveVisit) -> bool:
        """Whether the one block of the scene has just grown to where it must be cut."""
        limits = self.config.limits.block_limit, self.config.limits.sole_limit
        grown = active.sole and self._clocks.refined == self._clocks.steps
        return grown and is_full(len(self.params["means"]), 1, *limits)

    def _refine(self, infos: Infos, taken: int) -> None:
        clock = self._density_clock(taken)
        if self._crew is not None and infos:
            for part in self._crew.parts():
                self._growth = added(self._growth, part.counts)
        self._growth = self.density.after_step(self.params, self.optimizers, self._growth, infos, clock)
        if self.density.resets(clock):
            self._clocks = replace(self._clocks, resets=clock.steps // self.config.density.reset_every)
        if self.density.refines(clock, infos):
            self._clocks = replace(self._clocks, refined=clock.steps)
            self._hold_back_giants()

    def _hold_back_giants(self) -> None:
        if self.health.acts:
            self.health.hold_back_giants(self.views.values())

    @property
    def _progress_of_blocks(self) -> float:
        """Share of the run, its warm-up left out, that is done."""
        return max(self.progress - self.state.warm, 0.0) / (1 - self.state.warm)

    def _density_clock(self, taken: int) -> DensityClock:
        active = self._active
        views = self.state.views.get(active.geometry.block, len(active.geometry.views))
        blocks = self.scene.tree.num_blocks
        among_others = blocks > 1 and self.config.recipe.overlap == 0
        if blocks > 1:
            views = min(views, active.steps * self.batch)  # once a visit, even with thousands of photos
        return DensityClock(
            progress=self._progress_of_blocks,
            steps=self._clocks.steps,
            taken=taken,
            views=views,
            room=self.config.room(self.count(), len(self.params["means"]), blocks),
            seed=random.Random(f"density {self.config.seed} {self.state.step}").getrandbits(62),
            refined=self._clocks.refined if among_others else None,
            resets=self._clocks.resets if among_others else None,
            spent=active.done / active.steps if among_others else 0.0,
        )

    @property
    def layer_limit(self) -> int:
        """Bytes that layers may take, on the device and in RAM."""
        return sum(self._layer_room)

    @property
    def layer_bytes(self) -> int:
        """Bytes that the layers of the visit that is under way take; helpers' are not among them."""
        return self._layers.nbytes if self._layers else 0

    # -- at rest -------------------------------------------------------------------------------------

    def count(self) -> int:
        """Gaussians in the whole scene, the live block included."""
        return sum(self.scene.count(block) for block in range(self.scene.tree.num_blocks))

    @property
    def sh_degree(self) -> int:
        """The degree of spherical harmonics in use."""
        active = self.state.active
        restarts = self.config.recipe.sh_restart and active is not None and not active.sole
        share = active.done / active.steps if restarts else self.progress
        return sh_degree_at(share, self.config.recipe.sh_ramp, self.config.sh_degree)

    def save(self, pin: str | None = None) -> None:
        """Commit everything, the live block in the middle of its visit included.

        Args:
            pin: keep this state under a name until it is unpinned.
        """
        self._rest_amid_visit(0.0)
        if pin is not None:
            self.scene.store.pin(pin)

    def _rest_amid_visit(self, within: float) -> None:
        """Put the live block to rest under a number of its own, and the run's state."""
        updates = {}
        if (active := self.state.active) is not None:
            self.health.look_over()
            updates = {LIVE: self._detached()}
            active.saved = True
        self._rest(self.scene.tree, updates, within)

    def _rest(self, tree: BlockTree, updates: dict[int, BlockState], within: float) -> None:
        self.state.seconds = self.stopwatch.seconds
        self.scene.rest(tree, updates, self.state.to_json(), within)

    def restore(self) -> None:
        """Go on from the store's newest generation: where `save` was called, or something was put to rest."""
        self.state = RunState.from_json(self.scene.store.state)
        self.stopwatch = Stopwatch(self.state.seconds)
        if self.state.active is not None:
            self._attach(self.state.active)

    def close(self) -> None:
        """Write what waits to be written, and let go of the store, as `StoredScene.close`."""
        self.scene.close()

    @property
    def _active(self) -> ActiveVisit:
        if self.state.active is None:
            raise RuntimeError("no visit is under way: call next_batch first")
        return self.state.active

    def _begin_visit(self) -> None:
        degree, began = self.sh_degree, self.stopwatch.seconds
        if self.state.visit == 0 and has_scaffold(self.scene) and self.progress < self.config.warmup:
            self.state.active = self._planner.warm_up(degree, began)
        else:
            self.state.active = self._planner.next_visit(self.state, degree, began)
        self.state.active.crew = self._size_of_crew(self.state.active)
        self.state.visit += 1
        self._attach(self.state.active)

    def _attach(self, active: ActiveVisit) -> None:
        which = (self.scene, active.geometry.block, active.saved)
        check_room(count_at_rest(*which), self.config.sh_degree, self.device)
        rest = at_rest(*which).to(self.device)
        if active.done == 0 and not self.config.recipe.keep_moments:
            rest = rest.forgetful()
        attach(rest, self.params, self.optimizers, batch=self.batch)
        self.health.begin_visit(active, self.state.health)
        self._growth, self._clocks = {n: value.clone() for n, value in rest.growth.items()}, rest.clocks
        if active.done == 0 and not active.is_whole:
            self._hold_back_giants()
        block, seen = None if active.is_whole else active.geometry.block, len(active.geometry.views)
        self.scene.lay_over(block, lambda: live_gaussians(self.params))
        self._order = self._order_of(active)
        self.announce(VisitBegan(active.number, self.state.sweep, block, active.steps, seen, len(rest)))
        before = self.stopwatch.seconds
        self._crew = self._gather_crew(active)
        self._layers = self._draw_layers(active, self._order)
        active.layer_seconds += self.stopwatch.seconds - before
        if active.done == 0 and active.looked_at:
            shown = self._shown_in(active.looked_at, self.state.step)
            self.state.influence[active.geometry.block].update(shown)
        for plan in self.state.queue[:1]:
            self.scene.read_ahead(plan.block)

    def _order_of(self, active: ActiveVisit, member: int = 0) -> tuple[int, ...]:
        taken = 0 if active.is_alone else active.steps * (self.batch // active.crew)
        views = views_of_member(active.views, member, active.crew)
        return view_order(views, taken, active.number, self.config.seed, member)

    def _surroundings(self) -> BlockScene:
        """Where a visit's frozen blocks are drawn from."""
        return self.scene

    def _draw_layers(self, active: ActiveVisit, order: tuple[int, ...]) -> VisitLayers | None:
        if active.is_alone or self.scene.tree.num_blocks == 1 or not self.config.recipe.layers:
            return None
        painter = Painter(
            self._surroundings(),
            list(self.views.values()),
            self._rasterizer,
            ownership=self.config.recipe.ownership,
            pass_gaussians=self.config.limits.pass_gaussians or default_pass(self.scene),
            device=self.device,
        )
        layers = VisitLayers(
            painter,
            LayerStore(self.device, *(room // active.crew for room in self._layer_room)),
            active.geometry,
            self.scene.at_rest(active.geometry.block),
            self.views,
            PaintSettings(active.sh_degree, self.config.antialiased),
            window_weight=self.config.window_weight,
        )
        wanted = dict.fromkeys(order[active.done * (self.batch // active.crew) :])
        for done, _ in enumerate(layers.draw(wanted), start=1):
            self.announce(LayersDrawn(active.number, done, len(wanted)))
        if active.done == 0:
            self.state.count_drawn(len(self.params["means"]), layers.frozen)
        return layers

    def _end_visit(self) -> None:
        active = self._active
        self._clocks = replace(self._clocks, visits=self._clocks.visits + (not active.is_whole))
        state = self.health.end_visit(active, self._detached)
        if active.is_whole:
            self.state.warm = min(self.progress, self.config.warmup)
            live, views = live_gaussians(self.params).detach(), self.views.values()
            owner, options = self.scene.tree.assign(live.means), {"antialiased": self.config.antialiased}
            self.state.influence = influence(live, owner, views, self._rasterizer, **options)
        updates = settle(self.scene, active.geometry.block, state, self.config.recipe.migrate)
        limits = self.config.limits.block_limit, self.config.limits.sole_limit
        tree, updates = cut_full(self.scene, updates, self.state, *limits, self.announce)
        split = tree is not self.scene.tree
        if active.saved:
            updates[LIVE] = state.nobody
        self.scene.lift()
        if self._crew is not None:
            self._crew.dismiss()
        self.state.active, self._layers, self._crew = None, None, None
        crash_points.reached(crash_points.VISIT_TRAINED)
        self._rest(tree, updates, 0.0 if self.finished else self.config.commit_seconds)
        if split:
            self.density = self._density_control()
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

    def _detached(self) -> BlockState:
        return detach(self.params, self.optimizers, self._growth, self._clocks)
