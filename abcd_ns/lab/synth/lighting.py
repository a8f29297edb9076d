"""Sun, sky and the light that comes from them. All light is linear RGB."""

from dataclasses import dataclass

import numpy as np

from abcd_ns.lab.synth.geometry import Soup
from abcd_ns.lab.synth.noise import Array, fbm2, mix, smoothstep
from abcd_ns.lab.synth.raycast import Caster, spread_directions

SUN_LIGHT = np.float32([2.2, 1.98, 1.62])
_ZENITH = np.float32([0.16, 0.36, 0.85])
_HORIZON = np.float32([0.62, 0.76, 0.92])
_HAZE = np.float32([0.55, 0.66, 0.72])
_CLOUD = np.float32([1.45, 1.42, 1.38])
_SHADE = np.float32([0.75, 0.80, 0.90])
_BOUNCE = np.float32([0.16, 0.14, 0.11])
"""What an average sunlit surface sends back."""
_SKYLIGHT = np.float32([0.60, 0.72, 0.92])
_AMBIENT_RAYS = 96
_LIFT = 0.02
"""Metres from a vertex at which its ambient rays start."""


@dataclass(frozen=True)
class Sun:
    """A far light."""

    direction: Array
    """[3] unit vector towards it."""

    @staticmethod
    def from_seed(seed: int) -> "Sun":
        """Half-way up the sky, somewhere that is not along a wall."""
        rng = np.random.default_rng([seed, 77])
        azimuth = np.radians(rng.uniform(20, 70) + 90 * rng.integers(4))
        height = np.radians(rng.uniform(46, 56))
        return Sun(
            np.float32([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
        )


def sky(direction: Array) -> Array:
    """Radiance [n, 3] of the far dome in unit directions from its centre: gradient, clouds and hills."""
    x, y, z = direction[:, 0], direction[:, 1], direction[:, 2]
    none = np.zeros_like(z)
    color = mix(
        np.broadcast_to(_HORIZON, direction.shape), _ZENITH, smoothstep(-0.05, 0.85, np.maximum(z, 0)) ** 0.7
    )
    lift = 1.7 / (np.maximum(z, 0) + 0.32)
    thickness = fbm2(x * lift + 3.1, y * lift, 1.0, 4, none)
    cover = smoothstep(0.02, 0.55, thickness) * smoothstep(0.02, 0.3, z) * 0.9
    lit = fbm2(x * lift + 3.5, y * lift + 0.3, 1.0, 3, none)
    color = mix(
        color, mix(np.broadcast_to(_SHADE, direction.shape), _CLOUD, smoothstep(-0.5, 0.5, lit)), cover
    )
    flat = np.maximum(np.hypot(x, y), 1e-6)
    around_x, around_y = x / flat, y / flat
    ridges = ((0.15, 0.11, 2.0, (0.42, 0.54, 0.66)), (0.085, 0.06, 4.0, (0.27, 0.40, 0.36)))
    for height, swing, frequency, tone in ridges:
        ridge = height + swing * fbm2(around_x + height * 60, around_y, frequency, 4, none)
        low = mix(np.broadcast_to(_HAZE, direction.shape), np.float32(tone), smoothstep(0.0, 0.1, z))
        color = mix(color, low, smoothstep(-0.004, 0.004, ridge - z))
    return color


def haze(color: Array, position: Array, dome_radius: float) -> Array:
    """Radiance of far ground, fading into the dome's horizon; depends on the place alone, not the view."""
    far = np.hypot(position[:, 0], position[:, 1]) / dome_radius
    return mix(color, _HAZE, smoothstep(0.35, 1.0, far))


def ambient_light(soup: Soup, world: Caster) -> Array:
    """Light from the sky, and bounced off what hides it, at every corner of `soup`. [T, 3, 3]

    Irradiance over pi: the cosine-weighted mean over directions, by rays from each distinct vertex.
    """
    key = np.concatenate([soup.corners, soup.normals], axis=-1).reshape(-1, 6)
    _, first, back = np.unique(np.round(key, 4), axis=0, return_index=True, return_inverse=True)
    vertex = key[first]
    total = np.zeros((len(vertex), 3), np.float32)
    weight = np.zeros(len(vertex), np.float32)
    for direction in spread_directions(_AMBIENT_RAYS):
        cosine = vertex[:, 3:] @ direction
        lit = np.flatnonzero(cosine > 0.02)
        start = vertex[lit, :3] + _LIFT * vertex[lit, 3:]
        hidden = world.blocked(start, np.broadcast_to(direction, start.shape))
        open_sky = _SKYLIGHT * (0.45 + 0.55 * max(0.0, float(direction[2])))
        light = np.where(hidden[:, None] | (direction[2] < 0), _BOUNCE, open_sky)
        total[lit] += cosine[lit, None] * light
        weight[lit] += cosine[lit]
    return (total / weight[:, None])[back.reshape(-1)].reshape(-1, 3, 3)


def tone_map(radiance: Array) -> Array:
    """Linear light to sRGB values in [0, 1]: a soft shoulder, then the transfer curve of IEC 61966-2-1."""
    x = 1 - np.exp(-1.15 * radiance)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-6) ** (1 / 2.4) - 0.055)
