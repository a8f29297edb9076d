"""Of which degree the spherical harmonics of a Gaussian are, and of how many numbers that makes it."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import sh_degree_of

NUMBERS_WITHOUT_COLOR = 11
"""Of a Gaussian: mean, scales, quaternion, opacity."""


def degrees_in_use(parts: Sequence[Float[Tensor, "n k 3"]]) -> UInt8[Tensor, "n"]:
    """The highest degree of which a coefficient is not zero, in any of the parts."""
    used = torch.stack([(part != 0).any(dim=2) for part in parts]).any(dim=0)
    degrees = torch.where(used, _degrees(used.shape[1], used.device), 0)
    # One more column, for there may be none.
    return torch.nn.functional.pad(degrees, (1, 0)).amax(dim=1).to(torch.uint8)


def up_to_degree(degrees: Tensor, coefficients: int) -> Bool[Tensor, "n k"]:
    """Which of so many coefficients of degrees 1 and up belong to degrees, [n], or lower ones."""
    return _degrees(coefficients, degrees.device) <= degrees[:, None]


def _degrees(coefficients: int, device: torch.device) -> Tensor:
    return torch.tensor([sh_degree_of(k) + 1 for k in range(coefficients)], device=device)


def count_parameters(features_rest: Float[Tensor, "n k 3"]) -> int:
    """Of how many numbers Gaussians are, harmonics counted up to the highest degree in use of each."""
    bands = (degrees_in_use([features_rest]).long() + 1).square()
    return int((NUMBERS_WITHOUT_COLOR + 3 * bands).sum())
