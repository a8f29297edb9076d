from collections import Counter
from dataclasses import dataclass, field, fields

from torch import Tensor


@dataclass
class Counts:
    """What happened on the device."""

    copies_to_host: int = 0
    """Of tensors; values that are read one by one are waits alone."""
    bytes_to_host: int = 0
    copies_to_device: int = 0
    bytes_to_device: int = 0
    live_bytes: int = 0
    """Of all tensors that are there now."""
    peak_bytes: int = 0
    """The most that were there at once."""
    waits: Counter[str] = field(default_factory=Counter)
    """Points where the host waits for all that it has launched, by operation. Copies from and to pageable
    memory are among them, unless they go to the device and are called with `non_blocking`."""

    @property
    def waited(self) -> int:
        return sum(self.waits.values())

    def copy(self) -> "Counts":
        return self.since(Counts())

    def since(self, earlier: "Counts") -> "Counts":
        """What came after `earlier`; of the bytes that are there, this moment's."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        counted = values.keys() - {"live_bytes", "peak_bytes"}
        less = {name: values[name] - getattr(earlier, name) for name in counted}
        return Counts(**{**values, **less})

    def reset_peak(self) -> None:
        self.peak_bytes = self.live_bytes

    def wait(self, why: str) -> None:
        self.waits[why] += 1

    def move(self, tensor: Tensor, *, to_device: bool, blocks: bool = True) -> None:
        way = "to_device" if to_device else "to_host"
        setattr(self, f"copies_{way}", getattr(self, f"copies_{way}") + 1)
        setattr(self, f"bytes_{way}", getattr(self, f"bytes_{way}") + tensor.numel() * tensor.element_size())
        if blocks:
            self.wait(f"copy {way}".replace("_", " "))
