"""What stands in a court. Every function builds one thing at the origin, on the ground, z up, in metres."""

from collections.abc import Callable

import numpy as np

from abcd_ns.lab.synth.geometry import STANDING, Soup, ball, blob, box, hexahedron, lathe
from abcd_ns.lab.synth.textures import Color, Material, MaterialTable

_OAK: Color = (0.32, 0.19, 0.09)
_PALE_OAK: Color = (0.45, 0.30, 0.16)
_DARK: Color = (0.07, 0.045, 0.03)
_IRON: Color = (0.10, 0.10, 0.11)
_MARBLE: Color = (0.62, 0.60, 0.55)
_GREY: Color = (0.36, 0.36, 0.35)


class Workshop:
    """Makes the materials and draws the random choices of one court's props."""

    def __init__(self, table: MaterialTable, rng: np.random.Generator, accent: Color) -> None:
        self.table = table
        self.rng = rng
        self.accent = accent

    def material(
        self, kind: str, base: Color, second: Color, third: Color, size: tuple[float, float] = (1.0, 1.0)
    ) -> int:
        """A new row of the material table, with a salt of its own."""
        salt = float(self.rng.integers(0, 60))
        return self.table.add(Material(kind, base, second, third, size, salt))

    def oak(self, plank: float = 0.18) -> int:
        return self.material("blocks", _OAK, _DARK, _PALE_OAK, (plank, 2.0))

    def iron(self) -> int:
        return self.material("clouds", _IRON, _IRON, _IRON)

    def marble(self) -> int:
        warm = float(self.rng.uniform(0.85, 1.0))
        return self.material("clouds", _MARBLE, _GREY, (0.48, 0.46 * warm, 0.42 * warm))

    def leaves(self) -> int:
        warm = float(self.rng.uniform(0.0, 0.10))
        return self.material(
            "clouds", (0.08 + warm, 0.20, 0.04), (0.02, 0.05, 0.015), (0.22 + warm, 0.34, 0.07), (0.4, 1.0)
        )

    def paint(self) -> int:
        return self.material("clouds", self.accent, self.accent, self.accent)


def barrel(shop: Workshop) -> Soup:
    """A cask with iron hoops."""
    r, h = shop.rng.uniform(0.32, 0.4), shop.rng.uniform(0.85, 1.0)
    t = np.linspace(0, 1, 5)
    bulge = r * (0.82 + 0.18 * np.sin(np.pi * t))
    staves = [*zip(bulge, h * t, strict=True), (r * 0.76, h), (r * 0.76, h - 0.05), (0.0, h - 0.05)]
    parts = [lathe(staves, shop.oak(0.14), segments=16)]
    hoop = shop.iron()
    for z in (0.14, 0.36, 0.64, 0.86):
        ring = r * (0.82 + 0.18 * np.sin(np.pi * z))
        band = [(ring + 0.012, h * z - 0.03), (ring + 0.012, h * z + 0.03)]
        parts.append(lathe(band, hoop, segments=16))
    return Soup.cat(parts)


def crates(shop: Workshop) -> Soup:
    """Two boxes, the smaller on top and turned."""
    low, high = shop.rng.uniform(0.7, 0.9), shop.rng.uniform(0.45, 0.6)
    return Soup.cat(
        [_crate(shop, low), _crate(shop, high).placed((0.05, -0.04, low), shop.rng.uniform(0.2, 0.7))]
    )


def _crate(shop: Workshop, side: float) -> Soup:
    h, bar = side / 2, 0.08
    frame = shop.material("blocks", (0.20, 0.12, 0.06), _DARK, _OAK, (0.4, 2.0))
    parts = [box((-h, -h, 0), (h, h, side), shop.oak(0.15), 0.9, STANDING)]
    e = h + 0.025
    for x in (-1, 1):
        for y in (-1, 1):
            corner = sorted((x * e, x * (e - bar))), sorted((y * e, y * (e - bar)))
            low, high = (corner[0][0], corner[1][0], 0), (corner[0][1], corner[1][1], side + 0.02)
            parts.append(box(low, high, frame, 1.0, STANDING))
    for y in (-e, e - bar):
        parts.append(box((-h, y, side - bar), (h, y + bar, side + 0.02), frame, 1.0))
        parts.append(box((y, -h, side - bar), (y + bar, h, side + 0.02), frame, 1.0))
    return Soup.cat(parts)


def urn(shop: Workshop) -> Soup:
    """A clay pot with a bush."""
    profile = [
        (0.22, 0),
        (0.36, 0.22),
        (0.40, 0.42),
        (0.30, 0.62),
        (0.38, 0.72),
        (0.32, 0.72),
        (0.28, 0.6),
        (0, 0.6),
    ]
    clay = shop.material("clouds", (0.45, 0.20, 0.11), (0.30, 0.12, 0.07), (0.52, 0.27, 0.16))
    bush = blob(0.42, 0.25, shop.leaves(), shop.rng).placed((0, 0, 0.95))
    return Soup.cat([lathe(profile, clay, segments=18), bush])


def bench(shop: Workshop) -> Soup:
    """A plank on two stones."""
    oak, marble = shop.material("blocks", _OAK, _DARK, _PALE_OAK, (0.12, 2.0)), shop.marble()
    legs = [box((x - 0.1, -0.2, 0), (x + 0.1, 0.2, 0.42), marble, 0.5, STANDING) for x in (-0.6, 0.6)]
    return Soup.cat([*legs, box((-0.9, -0.26, 0.42), (0.9, 0.26, 0.5), oak, 0.5)])


def bush(shop: Workshop) -> Soup:
    """A low shrub."""
    return blob(shop.rng.uniform(0.5, 0.65), 0.3, shop.leaves(), shop.rng).placed((0, 0, 0.38))


def fountain(shop: Workshop) -> Soup:
    """Two bowls with water about a stem, a ball on top."""
    marble = shop.marble()
    pool = shop.material("clouds", (0.05, 0.17, 0.20), (0, 0, 0), (0.13, 0.33, 0.36))
    rim = [
        (1.55, 0),
        (1.55, 0.1),
        (1.42, 0.16),
        (1.42, 0.5),
        (1.55, 0.56),
        (1.55, 0.66),
        (1.3, 0.66),
        (1.3, 0.2),
    ]
    stem = [(0.32, 0.3), (0.2, 0.6), (0.2, 1.0), (0.75, 1.3), (0.8, 1.4), (0.68, 1.4), (0.6, 1.3)]
    spout = [(0.12, 1.3), (0.1, 1.8), (0.2, 1.85), (0.0, 1.86)]
    return Soup.cat(
        [
            lathe(rim, marble, segments=20),
            lathe([(1.32, 0.48), (0.0, 0.481)], pool, segments=20),
            lathe(stem, marble, segments=22),
            lathe([(0.66, 1.34), (0.0, 1.341)], pool, segments=22),
            lathe(spout, marble, segments=14),
            ball(0.2, shop.paint()).placed((0, 0, 2.03)),
        ]
    )


def tree(shop: Workshop) -> Soup:
    """A trunk in a stone ring with a crown of several clumps."""
    bark = shop.material("blocks", (0.20, 0.14, 0.09), _DARK, (0.30, 0.22, 0.14), (0.2, 2.0))
    ring = [(1.05, 0), (1.05, 0.4), (0.85, 0.4), (0.85, 0.25)]
    earth = shop.material("meadow", (0, 0, 0), (0, 0, 0), (0, 0, 0))
    parts = [
        lathe(ring, shop.marble(), segments=20),
        lathe([(0.86, 0.3), (0.0, 0.36)], earth, segments=20),
        lathe([(0.3, 0.3), (0.2, 0.8), (0.17, 1.6), (0.24, 2.2)], bark, segments=12),
    ]
    leaves = shop.leaves()
    for k in range(5):
        angle = 2 * np.pi * k / 4 + shop.rng.uniform(0, 0.8)
        out, up = (0.0, 3.5) if k == 4 else (0.7, shop.rng.uniform(2.3, 2.9))
        at = (out * np.cos(angle), out * np.sin(angle), up)
        parts.append(blob(shop.rng.uniform(0.7, 0.95), 0.3, leaves, shop.rng).placed(at))
    return Soup.cat(parts)


def _lying(soup: Soup) -> Soup:
    """Turned so that z points along x."""
    swap = np.array([2, 0, 1])
    return Soup(soup.corners[..., swap], soup.normals[..., swap], soup.uv, soup.material)


def tower(shop: Workshop, wall: int, trim: int, height: float, roofed: bool) -> Soup:
    """A round turret of the walls' stone, with a tiled cone or a flat battlement."""
    r = 0.85
    parts = [
        lathe([(r + 0.1, 0), (r + 0.1, 0.35), (r, 0.4)], trim, segments=18),
        lathe([(r, z) for z in np.linspace(0.4, height, 5)], wall, segments=18),
        lathe(
            [(r, height), (r + 0.14, height + 0.12), (r + 0.14, height + 0.3), (0, height + 0.3)],
            trim,
            segments=18,
        ),
    ]
    if roofed:
        tile = shop.material("blocks", (0.36, 0.12, 0.08), _DARK, (0.48, 0.20, 0.12), (0.3, 0.26))
        cone = [(r + 0.19, height + 0.3), (r * 0.5, height + 1.3), (0.0, height + 2.1)]
        parts += [lathe(cone, tile, segments=18), ball(0.12, shop.paint()).placed((0, 0, height + 2.15))]
    else:
        for k in range(8):
            block = box((r - 0.18, -0.2, 0), (r + 0.12, 0.2, 0.45), wall, 0.6, STANDING)
            parts.append(block.placed((0, 0, height + 0.3), 2 * np.pi * k / 8))
    return Soup.cat(parts)


def banner(shop: Workshop, height: float) -> Soup:
    """Cloth on a rod, hanging from `height` at y = 0, to be seen from -y."""
    pale = (0.66, 0.62, 0.50)
    cloth = shop.material("cloth", shop.accent, pale, pale, (0.36, 0.42))
    drop = shop.rng.uniform(1.3, 1.7)
    sheet = box((-0.54, -0.10, height - drop), (0.54, -0.07, height), cloth, 0.5)
    rod = _lying(lathe([(0.035, -0.68), (0.035, 0.68)], shop.oak(), segments=8)).placed((0, -0.085, height))
    return Soup.cat([sheet, rod])


def shelter(shop: Workshop, width: float) -> Soup:
    """A tiled lean-to, `width` metres along x, its high edge at y = 0, coming out to y = -1.15."""
    tile = shop.material("blocks", (0.38, 0.16, 0.09), _DARK, (0.50, 0.25, 0.14), (0.28, 0.24))
    oak, h = shop.oak(), width / 2
    base = np.array([[-h, -1.15, 1.95], [h, -1.15, 1.95], [h, 0, 2.45], [-h, 0, 2.45]], np.float64)
    roof = hexahedron(base, base + np.array([0, 0, 0.1]), tile, 0.6)
    posts = [
        box((x - 0.07, -1.05, 0), (x + 0.07, -0.91, 2.0), oak, 1.0, STANDING) for x in (0.1 - h, 0.0, h - 0.1)
    ]
    beam = box((-h, -1.06, 1.86), (h, -0.9, 1.98), oak, 0.8)
    return Soup.cat([roof, beam, *posts])


CENTREPIECES: tuple[Callable[[Workshop], Soup], ...] = (fountain, tree)
FURNITURE: tuple[Callable[[Workshop], Soup], ...] = (barrel, crates, urn, bench, bush)
