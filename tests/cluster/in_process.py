"""Workers in the driver's own process."""

from collections import deque
from collections.abc import Callable, Sequence

from abcd_ns.cluster.assignment import Assignment, Finished, Report
from abcd_ns.cluster.visit_worker import VisitWorker
from abcd_ns.engine.events import WorkerSeen
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.types import Gaussians


class InProcessWorkers:
    """As many as are asked for, who take turns.

    Args:
        count: how many visits are out at once.
    """

    def __init__(self, worker: VisitWorker, count: int = 1) -> None:
        self._worker, self._count = worker, count
        self._assignments: deque[Assignment] = deque()
        self._visits = 0

    @property
    def count(self) -> int:
        """How many visits are out at once."""
        return self._count

    @property
    def idle(self) -> int:
        """How many more could be."""
        return self._count - len(self._assignments)

    def share(self, value: Gaussians | BlockState) -> Callable[[], Gaussians | BlockState]:
        """The value itself: what is at rest never changes."""
        return lambda: value

    def submit(self, assignment: Assignment) -> None:
        """To be trained when someone waits for it."""
        self._assignments.append(assignment)

    def hold(self) -> bool:
        """Nothing is under way meanwhile."""
        return True

    def resume(self) -> None: ...

    def wait(self, seconds: float) -> list[Report]:  # noqa: ARG002 - nothing is under way meanwhile
        """Train the visit that was submitted first."""
        if not self._assignments:
            return []
        assignment = self._assignments.popleft()
        self._visits += 1
        return [
            Finished(
                assignment.number, self._worker.visit(assignment.task, assignment.state(), assignment.drawn)
            )
        ]

    def seen(self) -> Sequence[WorkerSeen]:
        """One, who is between two visits."""
        return [WorkerSeen(0, None, 0, 0, self._visits, 0, 0.0)]

    def close(self) -> None:
        """Nothing to end."""
