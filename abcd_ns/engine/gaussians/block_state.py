"""All that belongs to one block, and how it is kept: Gaussians, Adam moments, growth statistics, clocks."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import degrees_in_use, up_to_degree
from abcd_ns.engine.types import PARAM_NAMES, Gaussians, as_indices

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Adam's running moments, under torch's names."""
IS_DEFERRED, DEGREES = "waits", "degrees"
"""Columns: which Gaussians are deferred; the highest degree in use of each one's harmonics, and moments."""
DRAWN = (*PARAM_NAMES, IS_DEFERRED, DEGREES)
"""What is needed of a block to draw it."""


class Packed(NamedTuple):
    """A block, or some columns of it, as a store takes it; or a table of the run's, of no Gaussians.

    In training `features_rest` and its moments are [n, k, 3]. Here they are [m, 3], without the zeros beyond
    each Gaussian's degree: the coefficients of the first Gaussian, then those of the second, as many each as
    the column `degrees` says.
    """

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
        return Packed({name: value for name, value in self.tensors.items() if name in names}, self.meta)


@dataclass(frozen=True)
class Clocks:
    """How far a block has come; integers, so that schedules built on them are exact."""

    steps: int = 0
    """Views that were drawn to train the block."""
    adam_views: int = 0
    """Views' worth of decay that is in Adam's moments, which corrects their bias: a step of n views lets them
    forget as n steps of one would."""
    visits: int = 0
    """Visits that have ended."""
    refined: int = 0
    """`steps` when it was last refined."""


@dataclass(frozen=True)
class BlockState:
    """One block, as stored. Rows of every tensor belong to the same Gaussians."""

    gaussians: Gaussians
    exp_avg: Gaussians
    """First moment of each parameter."""
    exp_avg_sq: Gaussians
    """Second moment of each parameter."""
    growth: dict[str, Tensor] = field(default_factory=dict)
    """Density control's running statistics, each [n, ...]."""
    clocks: Clocks = field(default_factory=Clocks)
    deferred: Tensor | None = None
    """Bool [n]: deferred points, not drawn before the block's next visit. None defers nothing."""

    def __post_init__(self) -> None:
        if self.deferred is None:
            nobody = torch.zeros(len(self), dtype=torch.bool, device=self.gaussians.device)
            object.__setattr__(self, "deferred", nobody)
        rows = {len(self.gaussians), len(self.exp_avg), len(self.exp_avg_sq), len(self.deferred)}
        rows |= {value.shape[0] for value in self.growth.values()}
        if len(rows) != 1:
            raise ValueError(f"a block's tensors must have equally many rows, not {sorted(rows)}")

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def nobody(self) -> "BlockState":
        """None of its Gaussians, under its clocks; shares no memory, as an empty slice would."""
        return self[torch.zeros(0, dtype=torch.long, device=self.gaussians.device)]

    @staticmethod
    def fresh(gaussians: Gaussians) -> "BlockState":
        """A block that has not been trained: zero moments, clocks at zero."""
        moments = (Gaussians(*(torch.zeros_like(value) for _, value in gaussians.items())) for _ in MOMENTS)
        return BlockState(gaussians, *moments)

    def __getitem__(self, rows: Tensor | slice) -> "BlockState":
        """The Gaussians at `rows` with all that belongs to them; the clocks stay the block's."""
        rows = as_indices(rows)
        return self._each(lambda part: part[rows])

    def _each(self, change: Callable[[Any], Any]) -> "BlockState":
        """With each of its parts changed, but for the clocks."""
        gaussians, moments = change(self.gaussians), (change(getattr(self, name)) for name in MOMENTS)
        growth = {name: change(value) for name, value in self.growth.items()}
        return BlockState(gaussians, *moments, growth, self.clocks, change(self.deferred))

    def of_degree(self, sh_degree: int) -> "BlockState":
        """See `Gaussians.of_degree`."""
        moments = {name: getattr(self, name).of_degree(sh_degree) for name in MOMENTS}
        return replace(self, gaussians=self.gaussians.of_degree(sh_degree), **moments)

    def to(self, device: torch.device | str) -> "BlockState":
        return self._each(lambda part: part.to(device))

    def unpinned(self) -> "BlockState":
        """Out of pinned memory, into which a GPU copies."""
        return self[torch.arange(len(self))] if self.gaussians.means.is_pinned() else self

    def packed(self) -> Packed:
        """As it is kept, for the store; clocks as JSON."""
        parts = {"": self.gaussians, **{f"{moment}.": getattr(self, moment) for moment in MOMENTS}}
        degrees = degrees_in_use([part.features_rest for part in parts.values()])
        coefficients = self.gaussians.features_rest.shape[1]
        kept = up_to_degree(degrees, coefficients)
        tensors = {
            before + name: value[kept] if name == "features_rest" else value
            for before, part in parts.items()
            for name, value in part.items()
        }
        parameters = sum(tensors[name].numel() for name in PARAM_NAMES)
        tensors |= {DEGREES: degrees, IS_DEFERRED: self.deferred}
        tensors |= {f"growth.{name}": value for name, value in self.growth.items()}
        meta = {"clocks": vars(self.clocks), "coefficients": coefficients, "parameters": parameters}
        return Packed(tensors, meta)

    @staticmethod
    def unpacked(packed: Packed) -> "BlockState":
        """The inverse of `packed`; what need not be unpacked is shared."""
        columns = packed.tensors.items()
        growth = {k.removeprefix("growth."): v for k, v in columns if k.startswith("growth.")}
        moments = (packed.gaussians(f"{moment}.") for moment in MOMENTS)
        clocks, deferred = BlockState.clocks_of(packed.meta), packed.tensors[IS_DEFERRED]
        return BlockState(packed.gaussians(), *moments, growth, clocks, deferred)

    @staticmethod
    def clocks_of(meta: dict[str, Any]) -> Clocks:
        """Those in the JSON of `packed`; what older versions counted besides is passed over."""
        known = vars(Clocks())
        return Clocks(**{name: count for name, count in meta["clocks"].items() if name in known})


def join(states: Sequence[BlockState]) -> BlockState:
    """All in one, in order, moments and statistics included, under the clocks of the first; a single one is
    itself. A statistic which only some have starts at zero for the others."""
    if len(states) == 1:
        return states[0]
    known = {name: value[:0] for state in states for name, value in state.growth.items()}
    growth = {
        name: torch.cat([_statistic(state, name, like) for state in states]) for name, like in known.items()
    }
    return BlockState(
        Gaussians.cat([state.gaussians for state in states]),
        *(Gaussians.cat([getattr(state, moment) for state in states]) for moment in MOMENTS),
        growth,
        states[0].clocks,
        torch.cat([state.deferred for state in states]),
    )


def checksum(gaussians: Gaussians) -> str:
    """blake2b of all parameters, hexadecimal."""
    digest = hashlib.blake2b(digest_size=16)
    for _, value in gaussians.items():
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _statistic(state: BlockState, name: str, like: Tensor) -> Tensor:
    return state.growth[name] if name in state.growth else like.new_zeros((len(state), *like.shape[1:]))
