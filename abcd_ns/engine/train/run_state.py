"""Where a run stands, in JSON, so that it can stop anywhere and resume exactly."""

import copy
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import msgspec

from abcd_ns.engine.layers.footprints import VisitGeometry
from abcd_ns.engine.space.influence import Influence
from abcd_ns.engine.store.special_blocks import WHOLE, BlockName, from_text
from abcd_ns.engine.train.schedule import VisitPlan

UNLIMITED = 2**31
"""Steps of a visit that something else ends."""
TOO_FEW_VIEWS = 2
"""A block that no more views see has surfaces that nothing but the first Gaussians hold in place."""


class VisitKind(str, Enum):
    """What a visit trains."""

    BLOCK = "block"
    """One of several blocks, between layers of the others."""
    JOINT = "joint"
    """A block that is the whole scene: it lasts as long as the run, if the block need not be cut."""
    COARSE = "coarse"
    """The warm-up's coarse model of all blocks."""
    ISOLATED = "isolated"
    """A block with nothing around it, which is merged later."""


@dataclass(frozen=True)
class Budget:
    """How long a run may be. With both limits the one that is reached first counts."""

    steps: int | None = None
    """Optimisation steps for the whole scene."""
    seconds: float | None = None
    """Seconds of training, drawing layers included, evaluation and saving not."""

    def __post_init__(self) -> None:
        if self.steps is None and self.seconds is None:
            raise ValueError("a run needs a budget of steps or of seconds")

    def progress(self, steps: int, seconds: float) -> float:
        """The share of the run that is done, 0..1."""
        by_steps = steps / self.steps if self.steps else 0.0
        by_time = seconds / self.seconds if self.seconds else 0.0
        return min(max(by_steps, by_time), 1.0)


@dataclass
class ActiveVisit:
    """The visit that is under way."""

    number: int
    kind: VisitKind
    geometry: VisitGeometry
    sh_degree: int
    """In use from the visit's first step to its last, so that its layers stay right."""
    steps: int
    views: tuple[int, ...]
    """Indices of the views in use."""
    showing: tuple[int, ...] = ()
    """Those that are worth training the block on, of which each visit uses some; empty where all are used."""
    visible: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """By view, the blocks that its layers show, see `influence.visible_blocks`; missing views show all."""
    looked_at: tuple[int, ...] = ()
    """Those in use that hardly showed the block when last looked at."""
    done: int = 0
    saved: bool = False
    """Whether the active block was persisted in the middle of the visit, see special_blocks.ACTIVE."""
    batch: int = 0
    """Views in each of its steps; 0 for as many as steps have at most."""
    layer_seconds: float = 0.0
    """Training time that went into drawing F and B."""
    began: float = 0.0
    """Training time when the visit began."""
    since: float = 0.0
    """Share of the run that was done then."""
    until: float = 1.0
    """Share of the run at which the visit ends, whatever its steps."""
    shown: bool = False
    """Whether any picture has shown the block so far."""

    @property
    def trained_on(self) -> tuple[int, ...]:
        """Indices of the views that the block is trained on, in this visit or another."""
        return self.showing or self.geometry.views

    @property
    def is_joint(self) -> bool:
        """Whether the block is the whole scene."""
        return self.kind is VisitKind.JOINT

    @property
    def is_whole(self) -> bool:
        """Whether this is the warm-up."""
        return self.kind is VisitKind.COARSE

    @property
    def is_all(self) -> bool:
        """Whether the whole scene is in training."""
        return self.is_whole or self.is_joint

    @property
    def is_alone(self) -> bool:
        """Whether nothing lies around what is trained; the number of steps is not known then."""
        return self.kind is not VisitKind.BLOCK

    def share(self, progress: float) -> float:
        """Share of the visit's part of the run, mostly all of it, that is done at a share of the run."""
        if self.until <= self.since:  # time ran out as it began
            return 1.0
        return min(max((progress - self.since) / (self.until - self.since), 0.0), 1.0)


@dataclass
class BlockHealth:
    """Of one block, since the run began: counts, and facts of its last visit."""

    visits: int = 0
    """That ended."""
    gradients: int = 0
    """Rows of gradients that were no numbers and were set to zero. On an accelerator the first steps that
    have any are skipped, and count as a row each."""
    moments: int = 0
    """Rows of Adam's moments likewise."""
    values: int = 0
    """Gaussians that were no numbers: put back as they were stored, or replaced by transparent ones."""
    oversized: int = 0
    """Gaussians that were shrunk."""
    pruned: int = 0
    """Gaussians that filled too little of their views and were taken out."""
    hidden: bool = False
    """In the last visit no picture showed the block."""


HealthByBlock = dict[BlockName, BlockHealth]
"""By block; special_blocks.WHOLE for the warm-up. A block that was never visited is missing."""


@dataclass
class RunState:
    """All that the coordinator knows besides the blocks themselves."""

    step: int = 0
    """Optimisation steps taken in the whole scene."""
    sh_degree: int = 0
    """Of spherical harmonics, that any block has come to."""
    epoch: int = 0
    visit: int = 0
    """Visits begun so far."""
    queue: list[VisitPlan] = field(default_factory=list)
    """Visits of this epoch still to come."""
    of_epoch: int = 0
    """Views that all visits of this epoch were planned to draw."""
    views: dict[int, int] = field(default_factory=dict)
    """By block, how many views were worth training it on when last looked at; 0 means that none is."""
    influence: Influence = field(default_factory=dict)
    """As far as known; blocks that are missing are trained on all views that see them."""
    poses: dict[int, bytes] = field(default_factory=dict)
    """See Poses.packed; empty where all are as they were given."""
    uses: float = 0.0
    """Of each view by the whole scene, so far; counted where poses are refined. A block is its part of it."""
    posed: float = 0.0
    """Uses after which poses were last refined."""
    pruned_at: int = -1
    """Steps after which the final pruning was done."""
    health: HealthByBlock = field(default_factory=dict)
    """What had to be repaired, by block."""
    active: ActiveVisit | None = None
    in_flight: list[ActiveVisit] = field(default_factory=list)
    """Visits that workers are at, in the order in which they began; a run that resumes plans them anew."""
    seconds: float = 0.0
    """Training time up to the last save."""

    @property
    def planned(self) -> int:
        """Steps taken, and those that workers are to take."""
        return self.step + sum(visit.steps for visit in self.in_flight)

    def inherit(self, new: int, parent: int) -> None:
        """`new` was a part of `parent`: what is known of that holds for it too; it is visited next to it."""
        for known in (self.views, self.influence):
            if parent in known:
                known[new] = copy.copy(known[parent])
        if (record := self.health.get(parent)) is not None:  # what was repaired is counted once
            self.health[new] = BlockHealth(visits=record.visits)
        if self.active is not None:
            shown = self.active.visible
            shown |= {view: (*blocks, new) for view, blocks in shown.items() if parent in blocks}
        places = [place for place, plan in enumerate(self.queue) if plan.block == parent]
        for place in reversed(places):
            self.queue.insert(place + 1, self.queue[place]._replace(block=new))

    def renumber(self, blocks: int, influence: Influence) -> None:
        """The scene was cut anew into so many blocks, which nothing but their influence is known of. What was
        repaired in the old ones counts as the warm-up's."""
        old = [self.health.pop(block) for block in list(self.health) if block != WHOLE]
        whole = self.health.setdefault(WHOLE, BlockHealth())
        for name in ("gradients", "moments", "values", "oversized", "pruned"):
            setattr(whole, name, sum(getattr(record, name) for record in (whole, *old)))
        visits = min((record.visits for record in old), default=0)
        self.health |= {block: BlockHealth(visits=visits) for block in range(blocks)}
        self.influence, self.views = influence, {}
        self.epoch += 1

    def to_json(self) -> dict[str, Any]:
        """As JSON, which shares nothing with this state; `from_json` gives an equal one."""
        assigned = [VisitPlan(v.geometry.block, v.steps, v.batch) for v in self.in_flight]
        return msgspec.to_builtins(replace(self, queue=assigned + self.queue, in_flight=[]), str_keys=True)

    @staticmethod
    def from_json(data: dict[str, Any]) -> "RunState":
        """The inverse of `to_json`; of nothing, a new run. What older versions had besides is ignored."""
        state = msgspec.convert(data, RunState, str_keys=True)
        state.health = {from_text(block): record for block, record in state.health.items()}
        return state


def standing(block: int, record: BlockHealth | None, views: Mapping[int, int]) -> str:
    """How a block stands, in a few words, where so many views, see RunState, were worth training it on."""
    if views.get(block) == 0:
        return "seen by no view, left as it was"
    if record is None or record.visits == 0:
        return "not visited yet"
    if record.hidden:
        return "hidden behind others, passed over"
    if views.get(block, TOO_FEW_VIEWS + 1) <= TOO_FEW_VIEWS:
        return "seen by 1 view only" if views[block] == 1 else f"seen by {views[block]} views only"
    return "trained"


class Stopwatch:
    """Seconds of training, after so many before; can be paused for what does not count."""

    def __init__(self, seconds: float = 0.0, clock: Callable[[], float] = time.perf_counter) -> None:
        self._before, self._clock = seconds, clock
        self._since: float | None = None

    @property
    def seconds(self) -> float:
        running = 0.0 if self._since is None else self._clock() - self._since
        return self._before + running

    def start(self) -> None:
        """Count from now on; harmless when it already does."""
        if self._since is None:
            self._since = self._clock()

    def pause(self) -> None:
        """Stop counting until `start`."""
        self._before, self._since = self.seconds, None
