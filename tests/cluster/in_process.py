from collections.abc import Callable

from abcd_ns.cluster.assignment import Assignment, Finished, Member, Report, Workers
from abcd_ns.cluster.visit_worker import VisitWorker
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.types import Gaussians


class InProcessWorkers(Workers):
    """As many as are asked for, who take turns: none trains but while someone waits."""

    def __init__(self, worker: VisitWorker, count: int = 1) -> None:
        super().__init__([Member(number) for number in range(count)])
        self._worker = worker

    def share(self, value: Gaussians | BlockState) -> Callable[[], Gaussians | BlockState]:
        return lambda: value  # what is stored never changes

    def submit(self, assignment: Assignment) -> None:
        self._longest_idle().take(assignment)

    def hold(self) -> bool:
        return True

    def wait(self, seconds: float) -> list[Report]:  # noqa: ARG002 - nothing is under way meanwhile
        """Train the visit that was submitted first."""
        busy = [member for member in self._members if member.assignment is not None]
        if not busy:
            return []
        assignment = min(busy, key=lambda member: member.assignment.number).put_down()
        outcome = self._worker.visit(assignment.task, assignment.state(), assignment.drawn)
        return [Finished(assignment.number, outcome)]

    def close(self) -> None: ...
