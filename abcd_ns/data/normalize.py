"""Turns, centres and scales a scene in float64, so that float32 afterwards loses nothing."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from nerfstudio.cameras.camera_utils import auto_orient_and_center_poses, rotation_matrix_between

from abcd_ns.data import OPTION
from abcd_ns.data.input_errors import InputError

Orientation = Literal["pca", "up", "vertical", "none"]
_LEAST_UP = 0.1  # length of the mean of unit vectors below which they are taken to cancel
Center = Literal["poses", "focus", "none"]


@dataclass(frozen=True)
class Similarity:
    """x becomes scale x (rotation x + translation), in nerfstudio's order."""

    rotation: np.ndarray  # float64 [3, 3]
    translation: np.ndarray  # float64 [3], before scaling
    scale: float

    def points(self, xyz: np.ndarray) -> np.ndarray:
        """Points float64 [..., 3] in the new frame."""
        return self.scale * (xyz @ self.rotation.T + self.translation)

    def poses(self, camera_to_world: np.ndarray) -> np.ndarray:
        """Poses float64 [n, 3, 4] in the new frame; rotations stay rotations."""
        centers = self.points(camera_to_world[..., 3])
        return np.concatenate([self.rotation @ camera_to_world[..., :3], centers[..., None]], axis=-1)

    def after(self, transform: np.ndarray, scale: float) -> "Similarity":
        """This one applied after x -> scale x (transform [3, 4] @ x), as one Similarity."""
        rotation = self.rotation @ transform[:, :3]
        translation = self.rotation @ transform[:, 3] + self.translation / scale
        return Similarity(rotation, translation, self.scale * scale)

    @property
    def matrix(self) -> np.ndarray:
        """float64 [3, 4]: rotation and translation, without the scale."""
        return np.concatenate([self.rotation, self.translation[:, None]], axis=1)


def normalizing_similarity(
    poses: np.ndarray, orientation: Orientation, center: Center, auto_scale: bool, scale_factor: float
) -> Similarity:
    """The frame that nerfstudio's auto_orient_and_center_poses and auto_scale_poses choose for poses, camera
    to world, float64 [n, 3, 4], OpenGL convention.

    nerfstudio works in float32, where geo-referenced coordinates (1e6 m) have lost half a metre. So the
    mean of the centres is taken off in float64 first; both its rotation and its centre commute with that.
    """
    middle = poses[..., 3].mean(axis=0)
    near = torch.eye(4).repeat(len(poses), 1, 1)
    near[:, :3, :3] = torch.from_numpy(poses[..., :3])
    near[:, :3, 3] = torch.from_numpy(poses[..., 3] - middle)
    turn = torch.eye(3)
    if orientation in ("up", "vertical") and near[:, :3, 1].mean(dim=0).norm() < _LEAST_UP:
        # Up vectors cancel, as in flights that look down and turn about: what is behind the cameras is up.
        orientation, behind = "none", near[:, :3, 2].mean(dim=0)
        if behind.norm() >= _LEAST_UP:
            turn = rotation_matrix_between(behind, torch.tensor([0.0, 0.0, 1.0]))
        near[:, :3] = turn @ near[:, :3]
    try:
        _, transform = auto_orient_and_center_poses(near, method=orientation, center_method=center)
    except torch.linalg.LinAlgError:  # of the point that parallel cameras look at
        _, transform = auto_orient_and_center_poses(near, method=orientation, center_method="poses")
    transform[:, :3] = transform[:, :3] @ turn
    transform = transform.numpy().astype(np.float64)
    if not np.isfinite(transform).all():
        fix = f"set {OPTION}orientation-method none and center-method none"
        raise InputError(f"the cameras define no orientation or centre; {fix}.")
    u, _, vt = np.linalg.svd(transform[:, :3])
    rotation = u @ vt
    # With center "none" nerfstudio keeps the origin, so `middle` must not be taken off.
    translation = np.zeros(3) if center == "none" else transform[:, 3] - rotation @ middle
    reach = np.abs(Similarity(rotation, translation, 1.0).points(poses[..., 3])).max()
    if auto_scale and reach == 0:
        raise InputError(f"all cameras are at the origin; set {OPTION}auto-scale-poses False.")
    return Similarity(rotation, translation, scale_factor / reach if auto_scale else scale_factor)
