"""View-dependent colour: real spherical harmonics up to degree 3, in the order and signs of 3DGS."""

import math

from torch import Tensor

MAX_SH_DEGREE = 3
BASES = (MAX_SH_DEGREE + 1) ** 2 - 1
"""Basis functions of degrees 1 and up."""

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
    """0 for the three functions of degree 1, 1 for the five of degree 2, 2 for the seven of degree 3."""
    return math.isqrt(basis + 1) - 1
