"""What a drawn crop is shown in."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.types import Layer


class Frame(NamedTuple):
    """Two layers or none, a background, and what a pixel weighs."""

    front: Layer | None
    back: Layer | None
    background: Float[Tensor, "3"]
    counts: float
    """The gradient by the depth of a pixel that nothing hides, whatever the loss."""


Shown = tuple[tuple[slice, slice], Frame]
"""Rows and columns of a crop in what gsplat has drawn, and its frame."""
