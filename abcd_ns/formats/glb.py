"""glTF in one file (.glb) with KHR_gaussian_splatting, written part by part as .ply is.

The extension is Khronos', https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos: points with
linear scales, opacities from 0 to 1, quaternions (x, y, z, w), and a vector of three colours for each
spherical harmonic. A viewer that does not know it shows points in their colours (COLOR_0).
"""

import json
import struct
from collections.abc import Iterable
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.frames import quaternion
from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.ply import GENERATOR
from abcd_ns.units import bytes_in_words

EXTENSION = "KHR_gaussian_splatting"
Z_TO_Y = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
"""From nerfstudio's frame, in which z is up, to glTF's, in which y is."""
_FLOAT, _BYTE = 5126, 5121
_LARGEST = 2**32  # bytes: the file tells its length in 32 bits
_SPARE = 256  # bytes kept free in the JSON for the corners of the box, which are known last


class Attribute(NamedTuple):
    """What each Gaussian has, in `stride` bytes."""

    name: str
    kind: str
    stride: int
    component: int = _FLOAT


def attributes(sh_degree: int) -> list[Attribute]:
    """In the order of the file."""
    harmonics = [f"SH_DEGREE_{n}_COEF_{k}" for n in range(sh_degree + 1) for k in range(2 * n + 1)]
    return [
        Attribute("POSITION", "VEC3", 12),
        Attribute("COLOR_0", "VEC4", 4, _BYTE),
        Attribute(f"{EXTENSION}:ROTATION", "VEC4", 16),
        Attribute(f"{EXTENSION}:SCALE", "VEC3", 12),
        Attribute(f"{EXTENSION}:OPACITY", "SCALAR", 4),
        *(Attribute(f"{EXTENSION}:{name}", "VEC3", 12) for name in harmonics),
    ]


def values(gaussians: Gaussians) -> list[np.ndarray]:
    """For `attributes`, each [n, width]."""
    opacities = gaussians.opacities.sigmoid()
    quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True)
    found = [
        gaussians.means,
        quats[:, [1, 2, 3, 0]],
        gaussians.scales.exp(),
        opacities,
        gaussians.features_dc,
        *gaussians.features_rest.unbind(1),
    ]
    arrays = [value.float().cpu().numpy().astype("<f4") for value in found]
    srgb = (gaussians.features_dc * SH_C0 + 0.5).clamp(0, 1)
    linear = torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    color = torch.cat((linear, opacities), dim=1)
    return [arrays[0], (color * 255).round().to(torch.uint8).cpu().numpy(), *arrays[1:]]


def write_glb(
    path: Path,
    count: int,
    sh_degree: int,
    up: Float[Tensor, "3 3"],
    parts: Iterable[Gaussians],
    antialiased: bool = False,
) -> None:
    """As `write_scene`; UserError where one file cannot hold them. A node of the file has `up`, and values
    stay as they are. `antialiased` is noted in extras; the extension has no field for it."""
    columns = attributes(sh_degree)
    starts = list(accumulate((column.stride * count for column in columns), initial=0))
    document = _document(columns, starts, count, up)
    if antialiased:
        document["meshes"][0]["primitives"][0]["extras"] = {"antialiased": True}
    words = 4 * -(-(len(json.dumps(document)) + _SPARE) // 4)
    head = 12 + 8 + words + 8
    total = head + starts[-1]
    if total >= _LARGEST:
        raise UserError(f"{count:,} Gaussians: {bytes_in_words(total)}, and a .glb holds 4; use --by-block.")
    done, low, high = 0, np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
    with path.open("wb") as file:
        file.truncate(total)
        for gaussians in parts:
            found = values(gaussians)
            for column, start, value in zip(columns, starts, found, strict=False):
                file.seek(head + start + done * column.stride)
                file.write(value.tobytes())
            done += len(gaussians)
            low, high = np.minimum(low, found[0].min(0)), np.maximum(high, found[0].max(0))
        document["accessors"][0] |= {"min": low.tolist(), "max": high.tolist()}
        file.seek(0)
        file.write(struct.pack("<4sIII4s", b"glTF", 2, total, words, b"JSON"))
        file.write(json.dumps(document).encode().ljust(words))
        file.write(struct.pack("<I4s", starts[-1], b"BIN\0"))


def _document(
    columns: list[Attribute], starts: list[int], count: int, up: Float[Tensor, "3 3"]
) -> dict[str, Any]:
    w, x, y, z = quaternion(up).tolist()
    primitive = {
        "mode": 0,
        "attributes": {column.name: number for number, column in enumerate(columns)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": [x, y, z, w]}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": column.stride * count, "target": 34962}
            for column, start in zip(columns, starts, strict=False)
        ],
        "accessors": [
            {"bufferView": number, "componentType": column.component, "count": count, "type": column.kind}
            | ({"normalized": True} if column.component == _BYTE else {})
            for number, column in enumerate(columns)
        ],
    }
