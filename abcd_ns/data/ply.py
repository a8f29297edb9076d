"""Reads .ply files: points with their colours, and the Gaussians of 3D Gaussian Splatting.

Not by plyfile, which takes 20 s for a million points in ascii, where this takes 2 s. nerfstudio writes ascii.
"""

import io
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from abcd_ns.data.input_errors import InputError
from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.types import Gaussians

_NAMES = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64"
_TYPES = dict(zip(_NAMES.split(), ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"] * 2, strict=True))
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 16
GREY = 127  # colour of points that come without one
_COLORS = tuple(
    (f"{prefix}{red}", f"{prefix}{green}", f"{prefix}{blue}")
    for red, green, blue in (("red", "green", "blue"), ("r", "g", "b"))
    for prefix in ("", "diffuse_", "vertex_", "scalar_")
)  # what programs call colours, in lower case
_HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")
"""What files of Gaussians have in their place: colour = 0.5 + Y00 x coefficient (Kerbl et al., 2023)."""
_MOST = 20.0  # of an opacity's logit, and of minus a scale's logarithm, which files may hold as infinite
_RESTS = (0, 9, 24, 45)  # harmonics of a Gaussian above degree 0, three channels, for degrees 0 to 3
_WHITES = (255, 65_535, 4_294_967_295)  # what the brightest colour may be
_OVERSHOOT = 2  # times white: real numbers above it are still counted from that white, and clipped


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """The vertices of a .ply file, ascii or binary: (xyz float64 [n, 3], rgb uint8 [n, 3], or None in a file
    without colours). White is what the type and the largest value say: 1, 255, 65535 or 2^32 - 1."""
    if not path.is_file():
        raise InputError(f"{path} does not exist; correct ply_file_path, or remove it to start at random.")
    fix = "write the points again, or remove the file and any ply_file_path to start at random"
    points = _vertices(path, fix)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return xyz, _colors(points)


def some_means(path: Path, most: int) -> tuple[int, Float64[Tensor, "n 3"]]:
    """As `read_gaussians`: how many there are, and the finite means of up to so many, evenly spaced."""
    rows, groups = _rows(path)
    some = _columns(rows[:: -(-len(rows) // most)], groups["means"]).double()
    return len(rows), some[some.isfinite().all(dim=1)]


def is_antialiased(path: Path) -> bool:
    """Whether a .ply file says so, as `abcd export` marks it."""
    with path.open("rb") as file:
        return b"\ncomment antialiased\n" in file.read(_MAX_HEADER)


def read_gaussians(path: Path) -> tuple[Gaussians, int]:
    """The Gaussians of a .ply file as 3DGS, `abcd export` and other trainers write it; and how many rows are
    left out, since they hold NaN, or no rotation. InputError says what the file lacks."""
    rows, groups = _rows(path)
    found = {name: _columns(rows, group) for name, group in groups.items()}
    found["opacities"].clamp_(-_MOST, _MOST)
    found["scales"].clamp_(min=-_MOST)  # flat ones have no third
    sound = torch.stack([value.isfinite().all(dim=1) for value in found.values()]).all(dim=0)
    sound &= found["quats"].norm(dim=1) > 0
    found["features_rest"] = found["features_rest"].unflatten(1, (3, -1)).transpose(1, 2).contiguous()
    return Gaussians(**found)[sound], int((~sound).sum())


def _rows(path: Path) -> tuple[np.ndarray, dict[str, list[str]]]:
    """A row for each Gaussian, and by parameter the names of its columns."""
    if not path.is_file():
        lacks = "is a folder" if path.is_dir() else "does not exist"
        raise InputError(f"{path} {lacks}; correct --pipeline.model.init-splats.")
    fix = "--pipeline.model.init-splats wants a .ply of Gaussians, as `abcd export` writes it"
    rows = _vertices(path, fix)
    present = rows.dtype.names
    rest = sum(name.startswith("f_rest_") for name in present)
    groups = {
        "means": ["x", "y", "z"],
        "scales": [f"scale_{axis}" for axis in range(3)],
        "quats": [f"rot_{part}" for part in range(4)],
        "opacities": ["opacity"],
        "features_dc": list(_HARMONICS),
        "features_rest": [f"f_rest_{number}" for number in range(rest)],
    }
    missing = [name for group in groups.values() for name in group if name not in present]
    if missing or rest not in _RESTS:
        lacks = f"lacks {missing[0]}" if missing else f"has {rest} harmonics f_rest, not 0, 9, 24 or 45"
        raise InputError(f"{path} {lacks}; {fix}.")
    if not len(rows):
        raise InputError(f"{path} has no Gaussians; {fix}.")
    return rows, groups


def _columns(rows: np.ndarray, names: list[str]) -> Tensor:
    """float32 [n, c]."""
    found = np.empty((len(rows), len(names)), np.float32)
    for place, name in enumerate(names):
        found[:, place] = rows[name]
    return torch.from_numpy(found)


def _vertices(path: Path, fix: str) -> np.ndarray:
    """A row for each vertex, names in lower case; `fix` ends what is said of a file that cannot be read."""
    with path.open("rb") as file:
        head = file.read(_MAX_HEADER)
    end = head.find(b"\nend_header") + 1
    start = head.find(b"\n", end) + 1
    try:
        if not head.startswith(b"ply") or end == 0 or start == 0:
            raise ValueError("is not a .ply file")
        order, count, row, alone = _parse_header(head[:end].decode("ascii", "replace"))
        body = np.memmap(path, np.uint8, "r", start) if path.stat().st_size > start else np.empty(0, np.uint8)
        if order == "=":
            return _read_text(body, count, row)
        needed = count * row.itemsize
        if needed > len(body) or (alone and needed != len(body)):
            raise ValueError(f"claims {count} points, {needed} bytes, but has {len(body)}")
        return np.frombuffer(body, dtype=row, count=count)
    except ValueError as error:
        raise InputError(f"{path} {error}; {fix}.") from None


def _parse_header(header: str) -> tuple[str, int, np.dtype, bool]:
    """(byte order, rows, type of a row with names in lower case, whether nothing follows the vertices)."""
    order, elements = None, []
    try:
        for words in (line.split() for line in header.splitlines()):
            if words[:1] == ["format"]:
                order = _ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"] and len(elements) == 1:
                elements[0][2].append((words[2].lower(), order + _TYPES[words[1]]))
        name, count, fields = elements[0]
        row = np.dtype(fields)
    except (KeyError, IndexError, TypeError, ValueError):  # also where no format was given before
        raise ValueError("has a header that cannot be read") from None
    if order is None or name != "vertex" or count < 0 or not {"x", "y", "z"} <= set(row.names or ()):
        raise ValueError("does not start with vertices that have x, y and z")
    return order, count, row, len(elements) == 1


def _read_text(body: np.ndarray, count: int, row: np.dtype) -> np.ndarray:
    lines = body.tobytes().splitlines()[:count]
    try:
        table = np.loadtxt(io.BytesIO(b"\n".join(lines)), row, ndmin=1) if lines else np.empty(0, row)
    except ValueError:
        raise ValueError("has lines that cannot be read") from None
    if len(table) != count:
        raise ValueError(f"claims {count} points but has {len(table)}")
    return table


def _colors(points: np.ndarray) -> np.ndarray | None:
    """uint8 [n, 3] of red, green and blue; None without them."""
    present = set(points.dtype.names or ())
    names = next((names for names in (*_COLORS, _HARMONICS) if present.issuperset(names)), None)
    if names is None:
        return None
    rgb = np.stack([points[name] for name in names], axis=1)
    whites, slack = _WHITES, 1
    if np.issubdtype(rgb.dtype, np.floating):
        rgb = np.where(np.isfinite(rgb), rgb, 0)
        whites, slack = (1, *_WHITES), _OVERSHOOT
    if names == _HARMONICS:
        rgb, whites = 0.5 + SH_C0 * rgb, (1,)
    white = next((white for white in whites if rgb.max(initial=0) <= slack * white), whites[-1])
    return np.clip(np.round(rgb * (255 / white)), 0, 255).astype(np.uint8)
