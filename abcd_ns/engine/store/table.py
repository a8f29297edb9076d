"""What a run keeps in its store beside blocks: tensors that belong to no Gaussians."""

from typing import Any, NamedTuple

from torch import Tensor


class Table(NamedTuple):
    """Tensors by name, on the CPU, which nobody changes any more; as a store takes them."""

    tensors: dict[str, Tensor]
    meta: dict[str, Any]
    """Whatever JSON goes with them."""

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return sum(value.nbytes for value in self.tensors.values())
