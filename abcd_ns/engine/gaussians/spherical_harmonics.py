"""View-dependent colour: real spherical harmonics up to degree 3, in the order and signs of 3DGS.

Of which degree those of a Gaussian are, and of how many numbers that makes it.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

MAX_SH_DEGREE = 3
BASES = (MAX_SH_DEGREE + 1) ** 2 - 1
"""Basis functions of degrees 1 and up."""
NUMBERS_WITHOUT_COLOR = 11
"""Of a Gaussian: mean, scales, quaternion, opacity."""

SH_C0 = 0.5 / math.sqrt(math.pi)
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = math.sqrt(15 / math.pi) / 2
_C2_ZZ = math.sqrt(5 / math.pi) / 4
_C3_A = math.sqrt(35 / (2 * math.pi)) / 4
_C3_B = math.sqrt(105 / math.pi) / 2
_C3_C = math.sqrt(21 / (2 * math.pi)) / 4
_C3_ZZZ = math.sqrt(7 / math.pi) / 4


def sh_basis_rows(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Real spherical harmonics of degrees 1 to 3 at unit vectors: BASES tensors.

    The polynomials of Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013), with the
    Condon-Shortley sign. Degree 0 is the constant SH_C0 and left out.
    """
    xx, yy, zz = x * x, y * y, z * z
    ring = _C3_C * (5 * zz - 1)
    return [
        *(-_C1 * y, _C1 * z, -_C1 * x),
        *(_C2 * x * y, -_C2 * y * z, _C2_ZZ * (3 * zz - 1), -_C2 * x * z, 0.5 * _C2 * (xx - yy)),
        *(-_C3_A * y * (3 * xx - yy), _C3_B * x * y * z, -ring * y, _C3_ZZZ * z * (5 * zz - 3), -ring * x),
        *(0.5 * _C3_B * z * (xx - yy), -_C3_A * x * (xx - 3 * yy)),
    ]


def sh_degree_of(basis: int) -> int:
    """0 for the three functions of degree 1, 1 for the five of degree 2, 2 for the seven of degree 3. So
    it is the highest degree that so many functions come to."""
    return math.isqrt(basis + 1) - 1


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
