"""glTF in one file (.glb) with KHR_gaussian_splatting, written part by part as .ply is.

The extension is Khronos', https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos: points with
linear scales, opacities from 0 to 1, quaternions (x, y, z, w), and a vector of three colours for each
spherical harmonic. A viewer that does not know it shows points in their colours (COLOR_0).
"""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.similarity import quaternion
from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.ply import GENERATOR, Content
from abcd_ns.units import bytes_in_words

EXTENSION = "KHR_gaussian_splatting"
Z_TO_Y = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
"""From nerfstudio's frame, in which z is up, to glTF's, in which y is."""
_FLOAT, _BYTE = 5126, 5121
_LARGEST = 2**32  # bytes: the file tells its length in 32 bits
_SPARE = 256  # bytes kept free in the JSON for the corners of the box, which are known last


def values(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """What the file has of each Gaussian, in its order: [n, width], float32, or uint8 of COLOR_0."""
    opacities, sh_degree = gaussians.opacities.sigmoid(), gaussians.sh_degree
    srgb = (gaussians.features_dc * SH_C0 + 0.5).clamp(0, 1)
    linear = torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True)
    found = {
        "POSITION": gaussians.means,
        "COLOR_0": torch.cat((linear, opacities), dim=1),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": gaussians.scales.exp(),
        f"{EXTENSION}:OPACITY": opacities,
    }
    places = [(degree, k) for degree in range(sh_degree + 1) for k in range(2 * degree + 1)]
    harmonics = (gaussians.features_dc, *gaussians.features_rest.unbind(1))
    for (degree, k), harmonic in zip(places, harmonics, strict=True):
        found[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"] = harmonic
    arrays = {name: value.float().cpu().numpy().astype("<f4") for name, value in found.items()}
    arrays["COLOR_0"] = (found["COLOR_0"] * 255).round().to(torch.uint8).cpu().numpy()
    return arrays


def write_glb(path: Path, up: Float[Tensor, "3 3"], content: Content) -> None:
    """As `write_scene`; UserError where one file cannot hold them. A node of the file has `up`, and values
    stay as they are. `antialiased` is noted in extras; the extension has no field for it."""
    count, document = content.count, _document(content.count, content.sh_degree, up)
    if content.antialiased:
        document["meshes"][0]["primitives"][0]["extras"] = {"antialiased": True}
    words = 4 * -(-(len(json.dumps(document)) + _SPARE) // 4)
    head = 12 + 8 + words + 8
    binary = document["buffers"][0]["byteLength"]
    total = head + binary
    if total >= _LARGEST:
        raise UserError(f"{count:,} Gaussians: {bytes_in_words(total)}, and a .glb holds 4; use --by-block.")
    done, low, high = 0, np.full(3, np.inf, np.float32), np.full(3, -np.inf, np.float32)
    with path.open("wb") as file:
        file.truncate(total)
        for gaussians in content.parts:
            found = values(gaussians)
            for view, value in zip(document["bufferViews"], found.values(), strict=True):
                file.seek(head + view["byteOffset"] + done * value.shape[1] * value.itemsize)
                file.write(value.tobytes())
            done += len(gaussians)
            means = found["POSITION"]
            low, high = np.minimum(low, means.min(0)), np.maximum(high, means.max(0))
        document["accessors"][0] |= {"min": low.tolist(), "max": high.tolist()}
        file.seek(0)
        file.write(struct.pack("<4sIII4s", b"glTF", 2, total, words, b"JSON"))
        file.write(json.dumps(document).encode().ljust(words))
        file.write(struct.pack("<I4s", binary, b"BIN\0"))


def _document(count: int, sh_degree: int, up: Float[Tensor, "3 3"]) -> dict[str, Any]:
    """The file's JSON: what it has, and where in the binary part."""
    w, x, y, z = quaternion(up).tolist()
    columns, views, accessors, start = values(Gaussians.empty(sh_degree)), [], [], 0
    for number, column in enumerate(columns.values()):
        size = count * column.shape[1] * column.itemsize
        views.append({"buffer": 0, "byteOffset": start, "byteLength": size, "target": 34962})
        start += size
        component = _FLOAT if column.dtype == np.float32 else _BYTE
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[column.shape[1]]
        accessors.append({"bufferView": number, "componentType": component, "count": count, "type": kind})
        if component == _BYTE:
            accessors[-1]["normalized"] = True
    primitive = {
        "mode": 0,
        "attributes": {name: number for number, name in enumerate(columns)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    return {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": [x, y, z, w]}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": start}],
        "bufferViews": views,
        "accessors": accessors,
    }
