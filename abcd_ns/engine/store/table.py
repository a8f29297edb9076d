"""What a run keeps in its store beside blocks: tensors that belong to no Gaussians."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Table:
    """Tensors by name, on the CPU, which nobody changes any more."""

    tensors: dict[str, Tensor]
    meta: dict[str, Any]
    """Whatever JSON goes with them."""

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return sum(value.nbytes for value in self.tensors.values())

    def to_tensors(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """As the store takes it."""
        return self.tensors, self.meta
