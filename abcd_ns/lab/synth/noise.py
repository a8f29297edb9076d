"""Value noise from fixed random tables, and the filters that keep textures from aliasing.

`footprint` is everywhere the width in metres that one sample covers on the surface, [n]. Detail finer
than about two footprints is faded out, as a mip map would do.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

_SIDE2, _SIDE3 = 256, 32
_TABLE2 = np.random.default_rng(20240229).uniform(-1, 1, _SIDE2**2).astype(np.float32)
_TABLE3 = np.random.default_rng(20240301).uniform(-1, 1, _SIDE3**3).astype(np.float32)


def smoothstep(low: float, high: float, x: Array) -> Array:
    """0 below `low`, 1 above `high`, a smooth ramp between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mix(a: Array, b: Array, t: Array) -> Array:
    """a where t is 0, b where t is 1; `t` [n] is spread over the colours [n, 3]."""
    return a + (b - a) * t[:, None]


def fade(frequency: float | Array, footprint: Array) -> Array:
    """How much of a detail with `frequency` periods per metre a sample can resolve: 1 to 0 [n]."""
    return np.clip(1.6 - 3.2 * frequency * footprint, 0, 1)


def hash2(i: Array, j: Array, salt: Array | float = 0.0) -> Array:
    """A fixed random value in [-1, 1] per integer cell (given as floats) and salt."""
    row = (i + salt * 7).astype(np.int32) & (_SIDE2 - 1)
    column = (j + salt * 13).astype(np.int32) & (_SIDE2 - 1)
    return _TABLE2[row * _SIDE2 + column]


def _split(x: Array, side: int) -> tuple[NDArray, NDArray, Array]:
    """Lattice index, the next one, and the eased fraction."""
    floor = np.floor(x)
    f = x - floor
    i = floor.astype(np.int32) & (side - 1)
    return i, (i + 1) & (side - 1), f * f * (3 - 2 * f)


def noise2(x: Array, y: Array) -> Array:
    """Smooth noise in [-1, 1] with features one unit wide, [n]."""
    x0, x1, fx = _split(x, _SIDE2)
    y0, y1, fy = _split(y, _SIDE2)
    x0, x1 = x0 * _SIDE2, x1 * _SIDE2
    a, b = _TABLE2[x0 + y0], _TABLE2[x0 + y1]
    low = a + (_TABLE2[x1 + y0] - a) * fx
    return low + (b + (_TABLE2[x1 + y1] - b) * fx - low) * fy


def noise3(p: Array) -> Array:
    """Smooth noise in [-1, 1] of points [n, 3], with features one unit wide."""
    x0, x1, fx = _split(p[:, 0], _SIDE3)
    y0, y1, fy = _split(p[:, 1], _SIDE3)
    z0, z1, fz = _split(p[:, 2], _SIDE3)
    x0, x1, y0, y1 = x0 * _SIDE3**2, x1 * _SIDE3**2, y0 * _SIDE3, y1 * _SIDE3

    def slab(z: NDArray) -> Array:
        a, b = _TABLE3[x0 + y0 + z], _TABLE3[x0 + y1 + z]
        low = a + (_TABLE3[x1 + y0 + z] - a) * fx
        return low + (b + (_TABLE3[x1 + y1 + z] - b) * fx - low) * fy

    low = slab(z0)
    return low + (slab(z1) - low) * fz


def fbm2(x: Array, y: Array, frequency: float, octaves: int, footprint: Array) -> Array:
    """Noise of falling amplitude over `octaves` doublings of `frequency` (per metre), in about [-1, 1]."""
    total, amplitude = np.zeros_like(x), 0.6
    for k in range(octaves):
        f = frequency * 2**k
        weight = amplitude * fade(f, footprint)
        if weight.any():
            total += weight * noise2(x * f + 17.3 * k, y * f + 5.7 * k)
        amplitude *= 0.55
    return total


def fbm3(p: Array, frequency: float, octaves: int, footprint: Array) -> Array:
    """As `fbm2`, for points in space [n, 3]."""
    total, amplitude = np.zeros(len(p), np.float32), 0.6
    for k in range(octaves):
        f = frequency * 2**k
        weight = amplitude * fade(f, footprint)
        if weight.any():
            total += weight * noise3(p * np.float32(f) + np.float32(3.1 * k))
        amplitude *= 0.55
    return total
