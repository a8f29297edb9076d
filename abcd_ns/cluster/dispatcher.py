"""Trains blocks at once: assigns them to workers, and takes in what they made of them in a planned order.

`lag` visits are in flight. They are taken in one after the other, as they would end if all steps took equally
long, and whenever one is, the next begins from what is there by then. So a result depends on `lag`, not on
timing or on lost workers. With a lag of 1 a run is the same as one by a coordinator alone.

Blocks that are trained at once each make good their share of what is missing (`shared_residual`), in shorter
visits. docs/cluster.md says what it still costs.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from abcd_ns.cluster.assignment import Assignment, VisitOutcome, VisitTask, Workers, WorkersError
from abcd_ns.cluster.shared_residual import shown_beside
from abcd_ns.engine.events import EpochEnded, StepTaken, VisitBegan, WorkerLost, WorkersSeen
from abcd_ns.engine.store.commit import commit, with_pending
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.planner import BlocksBusyError
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit, BlockHealth
from abcd_ns.engine.train.step.batch import Rendered, Sample, Target
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.types import Gaussians

SLACK = 2  # visits begun and not yet taken in, for each worker: with 1 all would wait for the slowest
SECONDS = 0.5  # between two looks at the workers
LOSSES = 5  # workers that a visit may lose before the run gives up: it is the visit that ends them


class Dispatcher(Coordinator):
    """Assigns blocks to workers; what cannot be assigned, the warm-up, it trains as a coordinator does. A
    `lag` of None is SLACK for each worker, and fewer where there are fewer blocks."""

    def __init__(
        self,
        run: TrainingRun,
        workers: Workers,
        lag: int | None = None,
        room: LayerRoom | None = None,
        target: Callable[[Sample], Target] | None = None,
    ) -> None:
        super().__init__(run, room=room, target=target)
        self.workers, self._lag = workers, lag or SLACK * workers.count
        self._in_flight: list[Assignment] = []
        self._shown: dict[int, tuple[int, Callable[[], Gaussians]]] = {}
        self._numbers, self._ended = itertools.count(1), 0
        self._counted = self.state.step

    @property
    def trains_elsewhere(self) -> bool:
        """Whether the warm-up, or a visit that was saved in its midst, is over."""
        return self.state.active is None and not self.run.warm_up_is_next

    def await_step(self) -> None:
        """As the trainer's. WorkersError says that a visit lost LOSSES of them, or that there are none."""
        if not self._shown and self.device.type == "cuda":
            torch.cuda.empty_cache()  # of what was trained here: a worker may share this device
        while self._counted >= self.state.step and not self.finished:
            self.resume()  # a listener may have paused it
            self._assign()
            if self._counted < self.state.step or self.finished:
                break
            self._listen()
            self.announce(WorkersSeen(tuple(self.workers.seen())))
        self._counted += 1

    @property
    def finished(self) -> bool:
        """Whether the budget is used up, and all that was assigned is taken in."""
        return not self._in_flight and super().finished

    def pause(self) -> None:
        """No time counts until the next step, nor does anyone train, unless workers cannot be held."""
        if not self._in_flight or self.workers.hold():
            super().pause()

    def resume(self) -> None:
        self.workers.resume()
        super().resume()

    def after_step(self, rendered: Rendered, errors: Sequence[Tensor] = ()) -> None:
        super().after_step(rendered, errors)
        self._counted = self.state.step

    def _assign(self) -> None:
        """Take in the visits that are due, and begin as many as workers can take."""
        self._submit()
        steps = self.run.budget.steps
        while self.progress < 1.0 and (steps is None or self.state.planned < steps):
            if len(self._in_flight) < self._lag:
                if self.workers.idle == 0:
                    return
                if self._begin():
                    continue
            if not self._take_in_first():
                return
        while self._take_in_first():
            pass

    def _begin(self) -> bool:
        """Begin the next visit; whether there was one, since no block is in flight twice."""
        try:
            active = self.visits.begin(self._lag)
        except BlocksBusyError:
            return False
        state, scene, block, light = self.state, self.scene, active.geometry.block, self.run.light
        blocks = range(scene.tree.num_blocks)
        task = VisitTask(
            active=active,
            tree=scene.tree,
            counts=[scene.count(number) for number in blocks],
            bounds=[scene.bounds(number) for number in blocks],
            step=state.planned,
            seconds=self.stopwatch.seconds,
            epoch=state.epoch,
            health=state.health.get(block, BlockHealth()),
            light={} if light is None else {v: light.of(v).detach().cpu() for v in active.views},
            poses=self.run.poses.packed(),
            beside=self._beside(active),
            allowance=self._allowance(),
        )
        state.active = None
        state.in_flight.append(active)
        own, drawn = self.workers.share(with_pending(scene, block)), {b: self._as_drawn(b) for b in blocks}
        taken, ends = len(scene.pending_for(block) or ()), self._ended + active.steps * max(active.batch, 1)
        self._in_flight.append(Assignment(next(self._numbers), task, own, drawn, taken, ends))
        self._submit()
        return True

    def _as_drawn(self, block: int) -> Callable[[], Gaussians]:
        """What reads a block as it is now; what was shared before stays with the assignments that have it."""
        version = self.scene.version(block)
        if block not in self._shown or self._shown[block][0] != version:
            self._shown[block] = version, self.workers.share(self.scene.gaussians(block))
        return self._shown[block][1]

    def _beside(self, active: ActiveVisit) -> dict[int, float]:
        """By view, which part of the other blocks' weight is in flight meanwhile: begun before, or next."""
        state, block = self.state, active.geometry.block
        others = {visit.task.active.geometry.block for visit in self._in_flight}
        others |= {plan.block for plan in state.queue[: self._lag - 1]}
        blocks = self.scene.tree.num_blocks
        return shown_beside(state.influence, block, others - {block}, blocks, active.views)

    def _allowance(self) -> int | None:
        """The visit's part of what the scene's limit leaves: all visits in flight may grow."""
        limit = self.config.density.limit
        if limit is None:
            return None
        given = sum(visit.task.allowance for visit in self._in_flight)
        return max(limit - self.count() - given, 0) // max(self._lag - len(self._in_flight), 1)

    def _submit(self) -> None:
        for visit in self._in_flight:
            if not visit.submitted and self.workers.idle:
                # It may have waited for long.
                visit.task = task = replace(visit.task, seconds=self.stopwatch.seconds)
                self.workers.submit(visit)
                visit.submitted, active, block = True, task.active, task.active.geometry.block
                if not visit.losses:
                    seen, gaussians = len(active.trained_on), task.counts[block]
                    self.announce(VisitBegan(active.number, task.epoch, block, active.steps, seen, gaussians))

    def _listen(self) -> None:
        """Hear of workers, SECONDS at most."""
        for report in self.workers.wait(SECONDS):
            visit = next((v for v in self._in_flight if v.number == report.assignment), None)
            if visit is None or visit.outcome is not None:  # its assignment was given up
                continue
            match report.said:
                case (done, psnr):
                    self.announce(StepTaken(self.state.step, visit.task.active.number, done, psnr))
                case VisitOutcome() as outcome:
                    visit.outcome = outcome
                case str(why):
                    self._lose(visit, why)

    def _lose(self, visit: Assignment, why: str) -> None:
        visit.losses += 1
        self.announce(WorkerLost(block := visit.task.active.geometry.block, why))
        if visit.losses >= LOSSES:
            lost = f"The visit to block {block + 1} lost {LOSSES} workers, the last one so: {why}"
            fix = "free memory (abcd plan says what a block needs) and resume"
            raise WorkersError(f"{lost}. What other visits did is safe: {fix}.")
        visit.number, visit.submitted = next(self._numbers), False

    def _take_in_first(self) -> bool:
        """Take in the visit that is to end first, if it is done; whether one was."""
        visit = min(self._in_flight, key=lambda visit: visit.ends, default=None)
        if visit is None or visit.outcome is None:
            return False
        self._in_flight.remove(visit)
        self._ended = visit.ends
        outcome, active, state = visit.outcome, visit.task.active, self.state
        block, epoch = active.geometry.block, visit.task.epoch
        state.in_flight.remove(active)
        state.step += outcome.done
        if outcome.shown:
            state.influence[block].update(outcome.shown)
        state.health[block] = outcome.health
        active.layer_seconds = outcome.layer_seconds
        updates = commit(self.scene, block, outcome.state, self.config.recipe.migrate, visit.taken)
        self.persist_visit(active, outcome.state, updates, epoch)
        queued = state.epoch == epoch and state.queue
        if not queued and all(other.task.epoch != epoch for other in self._in_flight):
            self.announce(EpochEnded(epoch, state.step))
        return True

    def restore(self) -> None:
        """As the coordinator's; what workers are at is dropped, and planned again."""
        self._in_flight.clear()
        super().restore()
        self._counted = self.state.step

    def await_visits(self) -> bool:
        waits = any(visit.submitted for visit in self._in_flight)
        while True:
            # What no worker has, or has lost, is planned again when the run resumes.
            self._in_flight = [visit for visit in self._in_flight if visit.submitted]
            while self._take_in_first():
                pass
            if not self._in_flight:
                return waits
            self.resume()
            self._listen()

    def dismiss(self) -> None:
        self.workers.close()

    def close(self) -> None:
        try:
            self.dismiss()
        finally:
            super().close()
