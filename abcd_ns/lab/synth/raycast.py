"""Ray queries against a triangle soup, by Embree."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abcd_ns.errors import UserError
from abcd_ns.lab.synth.geometry import Soup
from abcd_ns.lab.synth.noise import Array

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene
except ImportError as error:
    raise UserError(
        f"Synthetic scenes are drawn with embreex, which does not start here ({error}): pip install embreex"
    ) from error


@dataclass(frozen=True)
class Hits:
    """The first triangle on each of n rays."""

    distance: Array
    """[n] metres along the unit direction; infinite where the ray meets nothing."""
    triangle: NDArray[np.int32]
    """[n] index into the soup; -1 where the ray meets nothing."""
    u: Array
    v: Array
    """[n] barycentric weights of the triangle's second and third corner."""


class Caster:
    """Answers what a ray meets first and whether anything is in its way."""

    def __init__(self, soup: Soup) -> None:
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(soup.corners, np.float32))
        # The first query builds the tree; do it here, so that threads find it ready.
        self.blocked(np.zeros((1, 3), np.float32), np.float32([[0, 0, 1]]))

    def first_hit(self, origins: Array, directions: Array) -> Hits:
        """The nearest triangles on rays [n, 3] with unit directions."""
        found = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            output=True,
        )
        triangle = found["primID"]
        distance = np.where(triangle >= 0, found["tfar"], np.float32(np.inf))
        return Hits(distance, triangle, found["u"], found["v"])

    def blocked(self, origins: Array, directions: Array, reach: Array | None = None) -> NDArray[np.bool_]:
        """Does anything lie on each ray, at most `reach` [n] (infinite by default) of its directions away?"""
        answer = self._scene.run(
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
            None if reach is None else np.ascontiguousarray(reach, np.float32),
            query="OCCLUDED",
        )
        return answer >= 0


def spread_directions(count: int) -> Array:
    """`count` unit vectors evenly over the sphere, on a Fibonacci spiral. [count, 3]"""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1).astype(np.float32)
