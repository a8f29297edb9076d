"""The whole scene, ready to be looked at along rays."""

from dataclasses import dataclass

import numpy as np

from abcd_ns.lab.synth.court import Site, build_court, build_field
from abcd_ns.lab.synth.geometry import Soup
from abcd_ns.lab.synth.lighting import SUN_LIGHT, Sun, ambient_light, haze, sky
from abcd_ns.lab.synth.noise import Array
from abcd_ns.lab.synth.raycast import Caster, Hits
from abcd_ns.lab.synth.textures import MaterialTable

_SHADOW_LIFT = 2e-3
"""Metres from a surface at which its shadow rays start."""


@dataclass(frozen=True)
class Sight:
    """What n rays see."""

    radiance: Array
    """[n, 3] linear light."""
    distance: Array
    """[n] metres to the surface or to the dome."""
    is_sky: np.ndarray
    """[n] True where the ray reaches the dome."""


class World:
    """All courts of a site with their light, under a far dome about the origin.

    Nothing depends on the direction of view except how finely a texture is resolved.
    """

    def __init__(self, site: Site) -> None:
        self.site = site
        self.dome_radius = max(60.0, 2.5 * site.half_diagonal)
        self.sun = Sun.from_seed(site.seed)
        self._table = MaterialTable()
        courts = [build_court(site, court, self._table) for court in range(len(site.cells))]
        field = build_field(self._table, self.dome_radius)
        self._soup = Soup.cat([*courts, field])
        self.caster = Caster(self._soup)
        # Court by court: the rays of one court are all that is in memory at a time.
        self._ambient = np.concatenate([ambient_light(part, self.caster) for part in (*courts, field)])

    @property
    def triangles(self) -> int:
        return len(self._soup)

    def to_dome(self, origins: Array, directions: Array) -> Array:
        """Distance [n] from points inside the dome to it, along unit directions."""
        along = np.einsum("ni,ni->n", origins, directions)
        inside = self.dome_radius**2 - np.einsum("ni,ni->n", origins, origins)
        return np.sqrt(along * along + inside) - along

    def look(self, origins: Array, directions: Array, pixel_angle: float) -> Sight:
        """What rays [n, 3] with unit directions see; `pixel_angle` is the width of one in radians."""
        hits = self.caster.first_hit(origins, directions)
        dome = self.to_dome(origins, directions)
        is_sky = ~(hits.distance < dome)
        distance = np.where(is_sky, dome, hits.distance)
        radiance = np.empty((len(distance), 3), np.float32)
        at = (origins[is_sky] + directions[is_sky] * dome[is_sky, None]) / np.float32(self.dome_radius)
        radiance[is_sky] = sky(at)
        ground = np.flatnonzero(~is_sky)
        seen = Hits(hits.distance[ground], hits.triangle[ground], hits.u[ground], hits.v[ground])
        radiance[ground] = self._shade(seen, directions[ground], pixel_angle)
        return Sight(radiance, distance, is_sky)

    def _shade(self, hits: Hits, directions: Array, pixel_angle: float) -> Array:
        """Lambertian radiance [n, 3] of the points hit: albedo x (sun x visibility + ambient)."""
        soup, triangle = self._soup, hits.triangle
        weights = np.stack([1 - hits.u - hits.v, hits.u, hits.v], axis=1)
        corners = soup.corners[triangle]
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        face /= np.linalg.norm(face, axis=1, keepdims=True)
        slant = np.einsum("ni,ni->n", face, directions)
        face *= -np.sign(slant)[:, None]
        position = np.einsum("nc,nci->ni", weights, corners)
        normal = np.einsum("nc,nci->ni", weights, soup.normals[triangle])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        uv = np.einsum("nc,nci->ni", weights, soup.uv[triangle])
        # Between the footprint across (1) and along (1 / cos) a slanted surface.
        footprint = hits.distance * np.float32(pixel_angle) / np.sqrt(np.maximum(np.abs(slant), 0.1))
        albedo = self._table.albedo(soup.material[triangle], uv, position, footprint)
        light = np.einsum("nc,nci->ni", weights, self._ambient[triangle])
        facing = np.clip(normal @ self.sun.direction, 0, 1)
        toward = np.flatnonzero((facing > 0) & (face @ self.sun.direction > 0))
        start = position[toward] + _SHADOW_LIFT * face[toward]
        shadow = self.caster.blocked(start, np.broadcast_to(self.sun.direction, start.shape))
        reached = toward[~shadow]
        light[reached] += facing[reached, None] * SUN_LIGHT
        return haze(albedo * light, position, self.dome_radius)
