"""A world of things under a sun and a far dome, and the light in it. All light is linear RGB."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.lab.world.solids import Rays, Thing
from abcd_ns.lab.world.textures import Colors, color, mix, smoothstep
from abcd_ns.lab.world.world import FAR, Seen, World

SUN = color((2.2, 1.98, 1.62))
ZENITH, HORIZON, HAZE = color((0.16, 0.36, 0.85)), color((0.62, 0.76, 0.92)), color((0.55, 0.66, 0.72))
BOUNCE = color((0.16, 0.14, 0.11))
"""What an average sunlit surface sends back."""
SKYLIGHT = color((0.50, 0.60, 0.78))
LIFT = 5e-3
"""Metres from a surface at which its shadow rays start."""


def sun_from_seed(seed: int) -> Float[Tensor, "3 1"]:
    """A unit vector half-way up the sky, somewhere that is not along a wall."""
    draw = torch.rand(3, generator=torch.Generator().manual_seed(77 + seed)).tolist()
    azimuth = torch.deg2rad(torch.tensor(20 + 50 * draw[0] + 90 * int(4 * draw[1])))
    height = torch.deg2rad(torch.tensor(46 + 10 * draw[2]))
    return torch.stack(
        [azimuth.cos() * height.cos(), azimuth.sin() * height.cos(), height.sin()]
    )[:, None]  # fmt: skip


def sky(direction: Rays) -> Colors:
    """Radiance of the far dome in unit directions from its centre: a gradient, and haze low down."""
    found = mix(HORIZON, ZENITH, smoothstep(-0.05, 0.85, direction[2].clamp_min(0)) ** 0.7)
    return mix(found, HAZE, 1 - smoothstep(0.0, 0.1, direction[2]))


def tone_map(radiance: Colors) -> Colors:
    """Linear light to sRGB values in [0, 1]: a soft shoulder, then the transfer curve of IEC 61966-2-1."""
    x = 1 - torch.exp(-1.15 * radiance)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp_min(1e-6) ** (1 / 2.4) - 0.055)


class SunlitWorld(World):
    """Things under a dome of `dome` metres about the origin.

    Nothing depends on the direction of view except how finely a texture is resolved.
    """

    def __init__(self, things: Sequence[Thing], dome: float, seed: int) -> None:
        self.all, self.dome, self.sun = Thing(tuple(things)), dome, sun_from_seed(seed)

    def look(self, origin: Tensor, directions: Tensor, pixel_angle: float) -> Seen:
        """As World.look; rays end on the dome at the latest."""
        rays = directions.T.float().contiguous()
        rays = rays / rays.norm(dim=0)
        start = origin.float()[:, None]
        t, which = self._nearest(start, rays)
        along = (start * rays).sum(dim=0)
        dome = (along.square() + self.dome**2 - start.square().sum()).sqrt() - along
        hit = t < dome
        t = t.minimum(dome)
        places = start + t * rays
        colors = sky(places / self.dome)
        near = hit.nonzero()[:, 0]
        if len(near):
            colors[:, near] = self._shade(which[near], places[:, near], rays[:, near], t[near] * pixel_angle)
        exact = origin.double() + t.double()[:, None] * rays.double().T
        return Seen(exact, hit, tone_map(colors).T)

    def blocked(self, origins: Rays, directions: Rays, reach: float = FAR) -> Bool[Tensor, "n"]:
        """Whether anything is on each ray, less than so many of its directions away."""
        return self._nearest(origins, directions, reach)[0] < reach

    def _nearest(self, origins: Rays, directions: Rays, reach: float = FAR) -> tuple[Tensor, Tensor]:
        """[n] how far along each ray the first solid is, `reach` at most, and its number."""
        t = torch.full_like(origins[0] + directions[0], reach)
        which = torch.full(t.shape, -1)
        self.all.meet(origins, directions, t, which)
        return t, which

    def _shade(self, which: Tensor, places: Rays, rays: Rays, footprint: Float[Tensor, "n"]) -> Colors:
        """Lambertian radiance of places on solids: albedo x (sun x visibility + sky and bounced light)."""
        normal, albedo = torch.empty_like(places), torch.empty_like(places)
        for number in which.unique().tolist():
            mine, solid = (which == number).nonzero()[:, 0], self.all.solids[number]
            at = places[:, mine]
            normal[:, mine], uv = solid.surface(at)
            slant = (normal[:, mine] * rays[:, mine]).sum(dim=0).abs()
            # Between the footprint across (1) and along (1 / cos) a slanted surface.
            albedo[:, mine] = solid.material.albedo(uv, at, footprint[mine] / slant.clamp_min(0.1).sqrt())
        light = mix(BOUNCE, SKYLIGHT, 0.55 + 0.45 * normal[2])
        facing = (normal * self.sun).sum(dim=0)
        toward = (facing > 0).nonzero()[:, 0]
        start = places[:, toward] + LIFT * normal[:, toward]
        reached = toward[~self.blocked(start, self.sun)]
        light[:, reached] += facing[reached] * SUN
        far = places[:2].norm(dim=0) / self.dome
        return mix(albedo * light, HAZE, smoothstep(0.35, 1.0, far))
