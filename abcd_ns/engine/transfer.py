"""Between host and device, without either waiting for the other."""

from collections import deque
from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

Parts = dict[str, list[Float[Tensor, ""]]]
Numbers = dict[str, list[float]]
"""The same, read."""


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor of the host on a device, which copies it when it comes to it."""
    if device.type == "cuda":
        tensor = tensor.contiguous().pin_memory()
    return tensor.to(device, non_blocking=True)


class StepNumbers:
    """The few numbers that a step leaves on the device, in one copy.

    On the CPU they are there at once. An accelerator is still at work when the host is done with a step:
    there they are best asked for when the next one is launched.

    Args:
        device: where they are; one that has no events is waited for at once.
    """

    def __init__(self, device: torch.device) -> None:
        module = None if device.type == "cpu" else torch.get_device_module(device)
        self._event = getattr(module, "Event", None)
        self._sent: deque[tuple[Any, dict[str, int], Tensor, Any]] = deque()

    @property
    def are_late(self) -> bool:
        """Whether they are better not asked for in the step that they are of."""
        return self._event is not None

    def send(self, about: Any, parts: Parts) -> None:
        """Have them copied; `about` is given back with them."""
        flat = [number for part in parts.values() for number in part]
        if not flat:
            return
        there = torch.stack(flat).to("cpu", non_blocking=self.are_late)
        event = self._event() if self.are_late else None
        if event is not None:
            event.record()
        self._sent.append((about, {name: len(part) for name, part in parts.items()}, there, event))

    def read(self, all_but: int = 0) -> Iterator[tuple[Any, Numbers]]:
        """Those that were sent and not read yet, but for the last so many: waits until they are there."""
        while len(self._sent) > all_but:
            about, counts, there, event = self._sent.popleft()
            if event is not None:
                event.synchronize()
            values = iter(there.tolist())
            yield about, {name: [next(values) for _ in range(count)] for name, count in counts.items()}
