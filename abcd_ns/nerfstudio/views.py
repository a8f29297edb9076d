"""nerfstudio's cameras as the engine's views."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from abcd_ns.data.input_errors import InputError
from abcd_ns.engine.space.distances import as_trained
from abcd_ns.engine.types import View


def view_of(cameras: Cameras, row: int = 0) -> View:
    """Camera `row` of a list of cameras, in OpenCV convention; an InputError if it is no perspective one."""
    if int(cameras.camera_type[row]) != CameraType.PERSPECTIVE.value:
        kind = CameraType(int(cameras.camera_type[row])).name.lower()
        raise InputError(f"Camera {row} is {kind}; Gaussians are drawn by perspective cameras: choose these.")
    pose = cameras.camera_to_worlds[row].detach()
    rotation = pose[:3, :3] * pose.new_tensor([1.0, -1.0, -1.0])  # OpenGL to OpenCV: flip y and z
    viewmat = torch.eye(4, dtype=pose.dtype, device=pose.device)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ pose[:3, 3]
    K = torch.eye(3, dtype=pose.dtype, device=pose.device)
    K[0, 0], K[1, 1] = cameras.fx[row].item(), cameras.fy[row].item()
    K[0, 2], K[1, 2] = cameras.cx[row].item(), cameras.cy[row].item()
    return View(viewmat, K, int(cameras.width[row]), int(cameras.height[row]), row)


def place_cameras(cameras: Cameras, poses: Mapping[int, Float[Tensor, "4 4"]]) -> None:
    """Put cameras where the engine has them: the inverse of `view_of`, by row, in place."""
    for row, viewmat in poses.items():
        rotation = viewmat[:3, :3].T
        cameras.camera_to_worlds[row, :, :3] = rotation * viewmat.new_tensor([1.0, -1.0, -1.0])
        cameras.camera_to_worlds[row, :, 3] = -rotation @ viewmat[:3, 3]


def views_of(cameras: Cameras) -> list[View]:
    """All cameras, each under its row as index."""
    return [view_of(cameras, row) for row in range(cameras.shape[0])]


def training_views(cameras: Cameras, points: Float[Tensor, "n 3"] | None, near: float = 0.0) -> list[View]:
    """All cameras, as a scene is trained with them; `near` 0 finds the near plane by the points."""
    return as_trained(views_of(cameras), torch.zeros(0, 3) if points is None else points.cpu(), near)
