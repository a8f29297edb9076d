"""Turns photos of a lens with distortion into photos of a pinhole camera."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from abcd_ns.data.input_errors import InputError
from abcd_ns.data.scene import Lens

_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
"""OpenCV puts pixel centres at whole numbers; Lens puts them at +0.5."""
_MAX_ZOOM = 10.0  # how much the focal length may change; real lenses, fisheyes too, stay well below


@dataclass(frozen=True)
class Undistortion:
    """What OpenCV needs to turn a photo of `lens` into one of `pinhole`."""

    lens: Lens
    pinhole: Lens  # the result: no distortion, and the size that is left after cropping to valid pixels
    corner: tuple[int, int]  # column and row of the result's first pixel before cropping

    def apply(self, image: np.ndarray) -> np.ndarray:
        """[lens.height, lens.width, c] to [pinhole.height, pinhole.width, c] of the same type, bilinear."""
        K, coefficients = self.lens.matrix - _HALF_PIXEL, np.array(self.lens.distortion)
        x, y = self.corner
        uncropped = self.pinhole.matrix - _HALF_PIXEL
        uncropped[:2, 2] += self.corner
        if self.lens.fisheye:
            flat = cv2.fisheye.undistortImage(image, K, coefficients, Knew=uncropped)
        else:
            flat = cv2.undistort(image, K, coefficients, None, uncropped)
        flat = flat.reshape(*flat.shape[:2], -1)
        return np.ascontiguousarray(flat[y : y + self.pinhole.height, x : x + self.pinhole.width])


@lru_cache(maxsize=4096)
def undistortion(lens: Lens) -> Undistortion:
    """The pinhole camera for a lens with distortion: the largest view without unseen pixels.

    As nerfstudio does: OpenCV's getOptimalNewCameraMatrix with alpha = 0, cropped to its valid rectangle, or
    the fisheye module's counterpart with balance = 0. Refuses coefficients that fold the image over itself,
    or leave no usable view.
    """
    K, coefficients = lens.matrix - _HALF_PIXEL, np.array(lens.distortion)
    if lens.fisheye:
        estimate = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify
        new = estimate(K, coefficients, lens.size, np.eye(3), balance=0)
        x, y, width, height = 0, 0, *lens.size
    else:
        new, (x, y, width, height) = cv2.getOptimalNewCameraMatrix(K, coefficients, lens.size, 0)
    zoom = np.array([new[0, 0] / lens.fx, new[1, 1] / lens.fy])
    is_mild = np.isfinite(new).all() and 1 / _MAX_ZOOM < zoom.min() <= zoom.max() < _MAX_ZOOM
    if not (is_mild and 2 * width > lens.width and 2 * height > lens.height):
        raise _unusable(lens)
    new = new + _HALF_PIXEL
    pinhole = Lens(width, height, new[0, 0], new[1, 1], new[0, 2] - x, new[1, 2] - y)
    _check_rays(lens, pinhole)
    return Undistortion(lens, pinhole, (x, y))


def _unusable(lens: Lens) -> InputError:
    values = ", ".join(f"{value:g}" for value in lens.distortion)
    has = f"a camera of {lens.width} x {lens.height} px has a distortion ({values}) that leaves no picture"
    fix = "make the model again with a simpler camera model, or undistort it with `colmap image_undistorter`"
    return InputError(f"{has}; {fix}.")


def _check_rays(lens: Lens, pinhole: Lens) -> None:
    """Follow rays from the middle of the result to its border: in the photo they must move outwards
    (a polynomial far from its fit turns back and mirrors the picture) and stay inside it."""
    t = np.linspace(-1, 1, 33)
    side = np.ones_like(t)
    border = np.concatenate([np.stack(s, 1) for s in ((t, side), (t, -side), (side, t), (-side, t))])
    border = (border + 1) / 2 * pinhole.size
    normal = (border - (pinhole.cx, pinhole.cy)) / (pinhole.fx, pinhole.fy)
    steps = np.linspace(0, 1, 65)[1:, None, None]
    pixels = distort(lens, (steps * normal).reshape(-1, 2)).reshape(len(steps), -1, 2)
    radii = np.linalg.norm((pixels - (lens.cx, lens.cy)) / (lens.fx, lens.fy), axis=-1)
    outside = np.maximum(-pixels[-1], pixels[-1] - lens.size).max()
    if not (np.diff(radii, axis=0) > 0).all() or not outside <= 2:
        raise _unusable(lens)


def distort(lens: Lens, rays: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of the rays (x, y, 1), given as [n, 2], in a photo of `lens`."""
    rays = np.ascontiguousarray(rays, dtype=np.float64)
    K, coefficients = lens.matrix, np.array(lens.distortion)
    if lens.fisheye:
        return cv2.fisheye.distortPoints(rays[:, None], K, coefficients)[:, 0]
    homogeneous = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    return cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), K, coefficients)[0][:, 0]
