"""Pictures of the world."""

import numpy as np
from numpy.typing import NDArray

from abcd_ns.lab.synth.cameras import Camera, Lens
from abcd_ns.lab.synth.lighting import tone_map
from abcd_ns.lab.synth.noise import Array
from abcd_ns.lab.synth.world import World

_RAYS_AT_ONCE = 1 << 17
"""Bounds the memory of a picture, whatever its size."""


def camera_rays(camera: Camera, lens: Lens, xy: NDArray) -> tuple[Array, Array]:
    """Origins and unit directions [n, 3] in world space of the rays through pixel positions [n, 2]."""
    rays = np.einsum("ij,ni->nj", camera.rotation, lens.directions(xy))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.center.astype(np.float32), rays.shape)
    return origins, rays.astype(np.float32)


def pixel_angle(lens: Lens, supersample: int) -> float:
    """Radians that one sample stands for. The pixel's own box filter lets it be finer than the pixel."""
    return max(0.7, 1 / supersample) / lens.focal


def render(world: World, camera: Camera, lens: Lens, supersample: int) -> NDArray[np.uint8]:
    """The picture [H, W, 3] in sRGB: the mean light of supersample^2 rays per pixel, on a regular grid."""
    fine = (np.arange(lens.width * supersample) + 0.5) / supersample
    rows = max(1, _RAYS_AT_ONCE // (len(fine) * supersample))
    picture = np.empty((lens.height, lens.width, 3), np.uint8)
    for top in range(0, lens.height, rows):
        bottom = min(top + rows, lens.height)
        lines = (np.arange(top * supersample, bottom * supersample) + 0.5) / supersample
        xy = np.stack(np.meshgrid(fine, lines), axis=-1).reshape(-1, 2)
        sight = world.look(*camera_rays(camera, lens, xy), pixel_angle(lens, supersample))
        light = sight.radiance.reshape(bottom - top, supersample, lens.width, supersample, 3)
        picture[top:bottom] = to_bytes(light.mean(axis=(1, 3)))
    return picture


def to_bytes(radiance: Array) -> NDArray[np.uint8]:
    """Linear light to 8-bit sRGB."""
    return np.round(np.clip(tone_map(radiance), 0, 1) * 255).astype(np.uint8)
