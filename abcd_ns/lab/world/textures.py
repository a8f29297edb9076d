"""What surfaces look like: colours from noise in space, as fine as a ray can tell.

`footprint` is everywhere the width in metres that one sample covers on the surface, [n]. Detail finer than
about two footprints is faded out, as a mip map would do.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Color = tuple[float, float, float]
"""Linear, 0..1."""
Values = Float[Tensor, "n"]
Colors = Float[Tensor, "3 n"]
_SIDE = 32
_TABLE = 2 * torch.rand(_SIDE**3, generator=torch.Generator().manual_seed(20240301)) - 1


def smoothstep(low: float, high: float, x: Values) -> Values:
    """0 below `low`, 1 above `high`, a smooth ramp between."""
    t = ((x - low) / (high - low)).clamp(0, 1)
    return t * t * (3 - 2 * t)


def mix(a: Colors, b: Colors, t: Values) -> Colors:
    """a where t is 0, b where t is 1."""
    return a + (b - a) * t


def color(values: Color) -> Float[Tensor, "3 1"]:
    """One colour for all places."""
    return torch.tensor(values)[:, None]


def hashed(i: Values, j: Values, salt: float = 0.0) -> Values:
    """A fixed random value in [-1, 1] per integer cell and salt."""
    row, column = (i + 7 * salt).long() & 127, (j + 13 * salt).long() & 255
    return _TABLE[row * 256 + column]


def noise(p: Float[Tensor, "3 n"]) -> Values:
    """Smooth noise in [-1, 1], with features one unit wide (value noise, from a fixed table)."""
    floor = p.floor()
    f = p - floor
    fx, fy, fz = f * f * (3 - 2 * f)
    low = floor.long() & (_SIDE - 1)
    (x0, y0, z0), (x1, y1, z1) = low, (low + 1) & (_SIDE - 1)

    def along_x(y: Tensor, z: Tensor) -> Values:
        a, b = _TABLE[(x0 * _SIDE + y) * _SIDE + z], _TABLE[(x1 * _SIDE + y) * _SIDE + z]
        return torch.lerp(a, b, fx)

    return torch.lerp(
        torch.lerp(along_x(y0, z0), along_x(y1, z0), fy), torch.lerp(along_x(y0, z1), along_x(y1, z1), fy), fz
    )


def fbm(p: Float[Tensor, "3 n"], frequency: float, octaves: int, footprint: Values) -> Values:
    """Noise of falling amplitude over `octaves` doublings of `frequency` (per metre), in about [-1, 1]."""
    total = torch.zeros_like(p[0])
    for k in range(octaves):
        f = frequency * 2**k
        weight = 0.6 * 0.55**k * (1.6 - 3.2 * f * footprint).clamp(0, 1)
        if bool(weight.any()):
            total += weight * noise(p * f + 17.3 * k)
    return total


@dataclass(frozen=True)
class Material:
    """One finish. What the colours and the size mean is up to the kind; see its method."""

    kind: Literal["blocks", "clouds"]
    base: Color
    """Linear albedo."""
    second: Color
    third: Color
    size: tuple[float, float] = (1.0, 1.0)
    """Metres: of a brick, a tile, a plank, a cloud."""
    salt: float = 0.0
    """Tells apart surfaces of the same finish."""

    def albedo(self, uv: Float[Tensor, "2 n"], position: Float[Tensor, "3 n"], footprint: Values) -> Colors:
        """Linear, within 0.01 .. 0.95.

        Args:
            uv: metres along the surface.
            position: metres, in the world.
        """
        at = position + self.salt
        found = self._clouds(at, footprint) if self.kind == "clouds" else self._blocks(uv, at, footprint)
        return found.clamp(0.01, 0.95)

    def _blocks(self, uv: Float[Tensor, "2 n"], at: Float[Tensor, "3 n"], footprint: Values) -> Colors:
        """Masonry, planks, tiles: blocks of `size` between base and third, joints of the second colour."""
        width, height = self.size
        row_at = uv[1] / height
        row = row_at.floor()
        column_at = uv[0] / width + 0.5 * (row % 2) + 0.1 * hashed(row, row, self.salt)
        column = column_at.floor()
        to_side = (0.5 - (column_at - column - 0.5).abs()) * width
        to_end = (0.5 - (row_at - row - 0.5).abs()) * height
        line = _joint(to_side.minimum(to_end), 0.03, footprint)
        seen = (1.6 - 3.2 * footprint / width).clamp(0, 1)
        tint, light = (hashed(column + k, row + k, self.salt) * seen for k in (0, 37))
        wear = fbm(at, 0.8, 2, footprint)
        found = mix(color(self.base), color(self.third), 0.5 + 0.5 * tint) * (1 + 0.1 * light + 0.2 * wear)
        return mix(found, color(self.second), 0.6 * line)

    def _clouds(self, at: Float[Tensor, "3 n"], footprint: Values) -> Colors:
        """Stone, leaves, grass: base and third in clouds of `size`, the second in the darkest places."""
        scale = self.size[0]
        cloud = fbm(at / scale, 1.0, 3, footprint / scale)
        found = mix(color(self.base), color(self.third), smoothstep(-0.6, 0.6, cloud)) * (1 + 0.25 * cloud)
        return mix(found, color(self.second), 0.6 * smoothstep(0.2, 0.7, -cloud))


def _joint(distance: Values, width: float, footprint: Values) -> Values:
    """How much of a footprint is covered by a line of `width`, at `distance` from its middle (box filter)."""
    cover = ((0.5 * (width + footprint) - distance) / footprint.clamp_min(1e-4)).clamp(0, 1)
    return cover.minimum(width / footprint.clamp_min(width))
