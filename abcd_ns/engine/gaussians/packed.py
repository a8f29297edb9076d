"""A block as it is kept: of each Gaussian the harmonics up to its degree, and no zeros beyond.

In training `features_rest` and its moments are [n, k, 3]. Here they are [m, 3]: the coefficients of the first
Gaussian, then those of the second, as many each as the column `degrees` says.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import degrees_in_use, up_to_degree
from abcd_ns.engine.types import PARAM_NAMES, Gaussians

IS_DEFERRED, DEGREES = "waits", "degrees"
"""Columns: which Gaussians are deferred; the highest degree in use of each one's harmonics, and moments."""
DRAWN = (*PARAM_NAMES, IS_DEFERRED, DEGREES)
"""What is needed of a block to draw it."""


class Packed(NamedTuple):
    """A block, or some columns of it, as a store takes it; or a table of the run's, of no Gaussians."""

    tensors: dict[str, Tensor]
    """Nobody changes them any more."""
    meta: dict[str, Any]
    """JSON. Of a block, `coefficients` is k; `parameters`, of how many numbers its Gaussians are."""

    @property
    def rows(self) -> int:
        """Gaussians."""
        return len(self.tensors["means"])

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        return sum(value.nbytes for value in self.tensors.values())

    def gaussians(self, before: str = "", device: torch.device | str = "cpu") -> Gaussians:
        """As they are drawn; or their moments, whose names have something before them. Unpacked on a device,
        which is sent no zeros."""
        values = {name: self.tensors[before + name].to(device) for name in PARAM_NAMES}
        packed, coefficients = values["features_rest"], self.meta["coefficients"]
        rest = packed.new_zeros(len(values["means"]), coefficients, 3)
        rest[up_to_degree(self.tensors[DEGREES].to(device), coefficients)] = packed
        return Gaussians(**{**values, "features_rest": rest})

    def drawn_at(self, rows: Bool[Tensor, "n"]) -> "Packed":
        """Some Gaussians, as others draw them; `parameters` stays that of all."""
        kept = rows.repeat_interleave((self.tensors[DEGREES].long() + 1).square() - 1)
        chosen = {name: self.tensors[name][kept if name == "features_rest" else rows] for name in DRAWN}
        return Packed(chosen, self.meta)

    def part(self, names: set[str]) -> "Packed":
        """Some columns."""
        return Packed({name: value for name, value in self.tensors.items() if name in names}, self.meta)


def pack(parts: Mapping[str, Gaussians]) -> Packed:
    """Gaussians, by "", and what else is shaped as they are, by what is set before the names."""
    degrees = degrees_in_use([part.features_rest for part in parts.values()])
    coefficients = parts[""].features_rest.shape[1]
    kept = up_to_degree(degrees, coefficients)
    tensors = {
        before + name: value[kept] if name == "features_rest" else value
        for before, part in parts.items()
        for name, value in part.items()
    }
    parameters = sum(tensors[name].numel() for name in PARAM_NAMES)
    return Packed({**tensors, DEGREES: degrees}, {"coefficients": coefficients, "parameters": parameters})
