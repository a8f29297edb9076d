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


def finest(device: torch.device) -> torch.dtype:
    """float64, or float32 where the device has none: Apple's."""
    return torch.float32 if device.type == "mps" else torch.float64


def upload(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor of the host on a device, which copies it when it comes to it, if it is not there."""
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor.contiguous().pin_memory()
    return tensor.to(device, non_blocking=True)


def event_of(device: torch.device) -> type | None:
    """What tells that a device has come to a point; None for one that has no such thing."""
    module = None if device.type == "cpu" else torch.get_device_module(device)
    return getattr(module, "Event", None)


class StepNumbers:
    """The few numbers that a step leaves on the device, in one copy.

    On the CPU they are there at once. An accelerator is still at work when the host is done with a step:
    there they are best asked for when the next one is launched.

    Args:
        device: where they are; one that has no events is waited for at once.
    """

    def __init__(self, device: torch.device) -> None:
        self._device, self._kind = device, event_of(device)
        self._sent: deque[tuple[dict[str, int], Tensor, Any]] = deque()

    @property
    def are_late(self) -> bool:
        """Whether they are better not asked for in the step that they are of."""
        return self._kind is not None

    def send(self, parts: Parts) -> None:
        """Have them copied."""
        flat = [number for part in parts.values() for number in part]
        if flat:
            counts = {name: len(part) for name, part in parts.items()}
            there = torch.stack(flat).to("cpu", non_blocking=self.are_late)
            self._sent.append((counts, there, self._recorded() if self.are_late else None))

    def _recorded(self) -> Any:
        """What tells that the device has come to here."""
        event = self._kind()
        # Of this device, which need not be the current one; Apple's has one stream, which has no name.
        stream = getattr(torch.get_device_module(self._device), "current_stream", None)
        if stream is None:
            event.record()
        else:
            event.record(stream(self._device))
        return event

    def read(self, all_but: int = 0) -> Iterator[Numbers]:
        """Those that were sent and not read yet, but for the last so many: waits until they are there."""
        while len(self._sent) > all_but:
            counts, there, event = self._sent.popleft()
            if event is not None:
                event.synchronize()
            values = iter(there.tolist())
            yield {name: [next(values) for _ in range(count)] for name, count in counts.items()}
