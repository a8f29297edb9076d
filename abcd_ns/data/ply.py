"""Reads the points of a .ply file: positions and colours, nothing else."""

import io
from pathlib import Path

import numpy as np

from abcd_ns.data.input_errors import InputError

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER = 1 << 16
GREY = 127
"""Colour of points that come without one."""


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of a .ply file, ascii or binary.

    Returns:
        (xyz float64 [n, 3], rgb uint8 [n, 3]); float colours are taken as 0 to 1, missing ones as grey.

    Raises:
        InputError: missing, not a .ply with x, y and z in its first element, or not as long as it claims.
    """
    if not path.is_file():
        raise InputError(
            f"{path} does not exist; correct ply_file_path, or remove it to start from random points."
        )
    content = path.read_bytes()
    end = content.find(b"end_header", 0, _MAX_HEADER)
    start = content.find(b"\n", end) + 1
    if not content.startswith(b"ply") or end < 0 or start == 0:
        raise _bad(path, "is not a .ply file")
    order, count, row, alone = _parse_header(path, content[:end].decode("ascii", "replace"))
    points = _read_rows(path, content[start:], order, count, row, alone)
    xyz = np.stack([points[axis] for axis in "xyz"], axis=1).astype(np.float64)
    return xyz, _colors(points)


def _bad(path: Path, what: str) -> InputError:
    return InputError(
        f"{path} {what}; write the points again, or remove ply_file_path to start from random points."
    )


def _parse_header(path: Path, header: str) -> tuple[str, int, np.dtype, bool]:
    """(byte order, rows, type of a row, whether nothing follows the vertices)."""
    order, elements = None, []
    try:
        for words in (line.split() for line in header.splitlines()):
            if words[:1] == ["format"]:
                order = _ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"] and len(elements) == 1:
                elements[0][2].append((words[2], order + _TYPES[words[1]]))
        name, count, fields = elements[0]
        row = np.dtype(fields)
    except (KeyError, IndexError, TypeError, ValueError):  # also where no format was given before
        raise _bad(path, "has a header that cannot be read") from None
    if order is None or name != "vertex" or count < 0 or not {"x", "y", "z"} <= set(row.names or ()):
        raise _bad(path, "does not start with vertices that have x, y and z")
    return order, count, row, len(elements) == 1


def _read_rows(path: Path, body: bytes, order: str, count: int, row: np.dtype, alone: bool) -> np.ndarray:
    if order == "=":
        lines = body.splitlines()[:count]
        if len(lines) < count:
            raise _bad(path, f"claims {count} points but has {len(lines)} lines")
        try:
            table = (
                np.loadtxt(io.BytesIO(b"\n".join(lines)), dtype=row, ndmin=1) if count else np.empty(0, row)
            )
        except ValueError:
            raise _bad(path, "has lines that cannot be read") from None
        if len(table) != count:
            raise _bad(path, f"claims {count} points but has {len(table)}")
        return table
    needed = count * row.itemsize
    if needed > len(body) or (alone and needed != len(body)):
        raise _bad(path, f"claims {count} points, {needed} bytes, but has {len(body)}")
    return np.frombuffer(body, dtype=row, count=count)


def _colors(points: np.ndarray) -> np.ndarray:
    """uint8 [n, 3] of red, green and blue."""
    names = ("red", "green", "blue")
    if not set(names) <= set(points.dtype.names or ()):
        return np.full((len(points), 3), GREY, dtype=np.uint8)
    rgb = np.stack([points[name] for name in names], axis=1)
    if np.issubdtype(rgb.dtype, np.floating):
        rgb = np.nan_to_num(rgb) * 255
    return np.clip(np.round(rgb), 0, 255).astype(np.uint8)
