"""Gaussians in another frame of coordinates."""

import math
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import MAX_SH_DEGREE, sh_basis_rows
from abcd_ns.engine.types import Gaussians

DIRECTIONS = 64
"""More than the 15 basis functions, so that the fit of a rotated basis is overdetermined and exact."""


@dataclass(frozen=True)
class Similarity:
    """A change of frame: x becomes scale x (rotation x + translation)."""

    rotation: Float[Tensor, "3 3"]
    """Of determinant 1; float64."""
    translation: Float[Tensor, "3"]
    """Before scaling; float64."""
    scale: float

    @staticmethod
    def of(transform: Float[Tensor, "3 4"], scale: float) -> "Similarity":
        """Of a dataparser: its transform, and the scale after that."""
        matrix = transform.double()
        return Similarity(matrix[:, :3], matrix[:, 3], float(scale))

    @property
    def inverse(self) -> "Similarity":
        turned = self.rotation.T @ self.translation
        return Similarity(self.rotation.T, -self.scale * turned, 1 / self.scale)

    def points(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points in the new frame, float64."""
        return self.scale * (points.double() @ self.rotation.T + self.translation)

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """The same Gaussians in the new frame; they look the same to a camera that moves along.

        Means are rounded to the Gaussians' dtype: far from the origin that costs digits.
        """
        like = gaussians.means
        quats = multiplied(quaternion(self.rotation), F.normalize(gaussians.quats.double(), dim=1))
        rest = gaussians.features_rest.double()
        turn = sh_rotation(self.rotation)[: rest.shape[1], : rest.shape[1]]
        moved = replace(
            gaussians,
            means=self.points(like),
            scales=gaussians.scales.double() + math.log(self.scale),
            quats=quats,
            features_rest=torch.einsum("ij,njc->nic", turn, rest),
        )
        return moved.to(like)


def sh_rotation(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "15 15"]:
    """The matrix M with Y(R d) = M Y(d) for the basis of degrees 1 to 3 in every direction d, float64.

    A function keeps its values while directions turn if its coefficients are multiplied by M, since M is
    orthogonal. Degrees do not mix (Ivanic and Ruedenberg, J. Phys. Chem. 100, 1996), so M is found degree by
    degree, from the basis in many directions.
    """
    generator = torch.Generator().manual_seed(0)
    directions = F.normalize(torch.randn(DIRECTIONS, 3, generator=generator, dtype=torch.float64), dim=1)
    turned = directions @ rotation.double().T
    before, after = (torch.stack(sh_basis_rows(*d.unbind(1)), dim=1) for d in (directions, turned))
    turn = before.new_zeros(before.shape[1], before.shape[1])
    for degree in range(1, MAX_SH_DEGREE + 1):
        members = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
        fit = torch.linalg.lstsq(before[:, members], after[:, members]).solution
        turn[members, members] = fit.T
    return turn


def quaternion(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "4"]:
    """(w, x, y, z) of a rotation, w >= 0; float64."""
    found = Rotation.from_matrix(rotation.double().cpu().numpy()).as_quat(canonical=True)
    return torch.from_numpy(found[[3, 0, 1, 2]]).to(rotation.device)


def multiplied(first: Float[Tensor, "4"], quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 4"]:
    """The rotations `quats`, followed by `first`."""
    w, v = first[0], first[1:]
    ws, vs = quats[:, :1], quats[:, 1:]
    scalar = w * ws - vs @ v[:, None]
    return torch.cat((scalar, w * vs + ws * v + torch.linalg.cross(v.expand_as(vs), vs)), dim=1)
