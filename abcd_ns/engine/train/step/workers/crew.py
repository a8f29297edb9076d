"""Several processes draw a step's views together, where there is no GPU.

A step of a small block is some hundred short operations, which a second thread hardly makes faster. Its views
have nothing to do with each other until their gradients are added up. So a *crew* shares them out: its first
member is the training process, the others are helpers forked from it when a visit begins. They draw the
layers of their own views, and end with the visit. In each step they are given the live parameters, and give
back losses, gradients, and what density control counts.

A helper that is lost, or has no room for a block that has grown, is stood in for: the training process draws
its share as it would have. What a run computes depends on the size of its crew, and not on how many live. An
error in a helper ends the run, as one in the training process does.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.train.step.workers.helper_process import HelperProcess, Room
from abcd_ns.engine.train.step.workers.share import Contribution, Drawn, DrawShare, Share, Task
from abcd_ns.engine.train.step.workers.shared_memory import SharedRows
from abcd_ns.engine.types import Gaussians

GROWTH, SPARE = 4, 4096
"""Rows of a visit's shared memory: so many times its Gaussians, and some. What is not used takes none."""


class Helper:
    """A member of a crew: a process, or the training process in its stead.

    Args:
        process: None if there is none.
        draw: what draws its share, here.
    """

    def __init__(self, room: Room, process: HelperProcess | None, draw: DrawShare) -> None:
        self._room, self._process, self._draw = room, process, draw
        self._asked: tuple[Gaussians, Task] | None = None
        self._drawn: Drawn | None = None
        self._share: Share | None = None

    @property
    def pid(self) -> int | None:
        """Of its process, as far as there is one."""
        return self._process and self._process.pid

    def begin(self, live: Gaussians, task: Task, fits: bool) -> None:
        """Let it begin a step."""
        self._asked, self._drawn, self._share = (live, task), None, None
        if not fits:
            self.end()  # it stays too large: blocks seldom shrink
        if self._process is not None:
            self._process.ask(len(live), task)

    def drawn(self) -> Drawn:
        """What is known of its share once it is drawn; waits for that."""
        if self._drawn is None:
            self._drawn = self._answer()
        if self._drawn is None:
            self._share = self._stand_in()
            self._drawn = self._share.drawn
        return self._drawn

    def contribution(self) -> Contribution:
        """What its share adds to the step; waits for it."""
        self.drawn()
        if self._share is None:
            given = self._answer()
            if given is not None and self._asked is not None:
                return self._room.take(len(self._asked[0]), given)
            self._share = self._stand_in()
        return self._share.differentiate()

    def end(self) -> None:
        """End its process."""
        if self._process is not None:
            self._process.end()
            self._process = None

    def _answer(self) -> Any | None:
        found = None
        try:
            found = self._process and self._process.answer()
        finally:
            if found is None:
                self.end()
        return found

    def _stand_in(self) -> Share:
        if self._asked is None:
            raise RuntimeError("no step was begun")
        live, task = self._asked
        leaves = {name: value.detach().clone().requires_grad_() for name, value in live.items()}
        with torch.enable_grad():
            return self._draw(Gaussians(**leaves), task)


class Crew:
    """All members of a crew but the first, as the first sees them.

    Args:
        draws: for each helper, what makes that which draws its shares: called with True in its own process,
            and with False where another must stand in.
        gaussians: the block as it is when the visit begins.
        forks: whether there may be processes.
    """

    def __init__(
        self, draws: Sequence[Callable[[bool], DrawShare]], gaussians: Gaussians, *, forks: bool
    ) -> None:
        self._limit = GROWTH * len(gaussians) + SPARE
        self._params = SharedRows.like(gaussians, self._limit)
        self._threads = torch.get_num_threads()
        torch.set_num_threads(1)  # each member has a core to itself
        self._helpers = []
        for make in draws:
            room = Room(self._params, gaussians, self._limit)
            process = HelperProcess(room, lambda make=make: make(True)) if forks else None
            self._helpers.append(Helper(room, process, make(False)))
        self._contributions: list[Contribution] | None = []
        self._joined: Tensor | None = None

    @property
    def pids(self) -> tuple[int, ...]:
        """Of the processes that there are."""
        return tuple(helper.pid for helper in self._helpers if helper.pid is not None)

    def begin(self, live: Gaussians, task: Task) -> None:
        """Let the helpers begin a step."""
        if self._contributions is None:  # the last step's gradient was never asked for
            self.contributions()
        fits, self._contributions = len(live) <= self._limit, None
        if fits and self.pids:
            self._params.write(dict(live.items()))
        for helper in self._helpers:
            helper.begin(live.detach(), task, fits)
        # autograd takes first what was made last: so it does not wait here before its own part is done.
        self._joined = _Joined.apply(self, *(value for _, value in live.items()))

    def drawn(self) -> list[Drawn]:
        """What is known of the helpers' shares once they are drawn; waits for that."""
        return [helper.drawn() for helper in self._helpers]

    def loss(self) -> Float[Tensor, ""]:
        """The helpers' part of the step's loss, differentiable in the live parameters; once a step."""
        if self._joined is None:
            raise RuntimeError("no step was begun")
        return self._joined + sum(each.loss for each in self.drawn())

    def contributions(self) -> list[Contribution]:
        """What the helpers add to the step; waits for them."""
        if self._contributions is None:
            self._contributions = [helper.contribution() for helper in self._helpers]
        return self._contributions

    def dismiss(self) -> None:
        """End all processes. Harmless when done twice."""
        for helper in self._helpers:
            helper.end()
        torch.set_num_threads(self._threads)


class _Joined(torch.autograd.Function):
    """Zero, as a function of the live parameters whose gradients come from helpers."""

    @staticmethod
    def forward(ctx: Any, crew: Crew, *live: Tensor) -> Tensor:
        ctx.crew = crew
        return live[0].new_zeros(())

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        by_parameter = zip(*(part.gradients.values() for part in ctx.crew.contributions()), strict=True)
        return None, *(upstream * torch.stack(rows).sum(dim=0) for rows in by_parameter)
