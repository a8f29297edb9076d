"""The formats of an exported scene, chosen by the file's suffix, and how large its files would be."""

from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.render.splat_kernels import MIN_ALPHA
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.glb import write_glb
from abcd_ns.formats.packed import BYTES_AT_ONCE, check_installed, packed
from abcd_ns.formats.ply import Content, columns, header, pieces

PACKED = (".compressed.ply", ".spz", ".sog")
SUFFIXES = (*PACKED, ".ply", ".glb")  # the longer of two that fit comes first
SPZ_STEP, SPZ_REACH = 1 / 4096, 2048.0
"""What .spz rounds positions to, and how far from the origin they may be: 24 bits, 12 of them below one."""

MOST_AT_ONCE = 4 * 2**30 // BYTES_AT_ONCE  # packed only to see how small they become: 4 GiB of RAM


def shows(opacities: Float[Tensor, "n 1"]) -> Bool[Tensor, "n"]:
    """By the logits of opacities, which Gaussians some rasterizer would show; files leave out the others."""
    return torch.sigmoid(opacities[:, 0]) >= MIN_ALPHA


def suffix_of(path: Path, missing: str | None = None) -> str:
    """Which of SUFFIXES the path has, or else `missing`; UserError where nothing writes such files."""
    found = next((suffix for suffix in SUFFIXES if path.name.lower().endswith(suffix)), missing)
    if found is None:
        raise UserError(f"--out {path} must end in one of {', '.join(sorted(SUFFIXES))}.")
    if found in PACKED:
        check_installed()
    return found


def rounding(suffix: str, largest: float) -> float:
    """By how much positions up to `largest` may be off; UserError where the format cannot hold them."""
    if suffix != ".spz":
        return largest * torch.finfo(torch.float32).eps
    if largest >= SPZ_REACH:
        reach = f"reaches {SPZ_REACH:.0f} units from the origin, and the scene {largest:,.0f}"
        raise UserError(f".spz {reach}; use --frame nerfstudio, or another format.")
    return SPZ_STEP / 2


def write_scene(path: Path, suffix: str, up: Float[Tensor, "3 3"], content: Content) -> None:
    """Write Gaussians in the format of a suffix. `up` turns their frame so that y is up."""
    if suffix == ".ply":
        with path.open("wb") as file:
            file.writelines(pieces(content))
    elif suffix == ".glb":
        write_glb(path, up, content)
    else:
        path.write_bytes(packed(suffix[1:], content))


def ply_bytes(gaussians: Gaussians) -> int:
    """Of the .ply that `abcd export` writes."""
    degree, count = gaussians.sh_degree, int(shows(gaussians.opacities).sum())
    return len(header(count, degree)) + 4 * len(columns(degree)) * count


def spz_bytes(gaussians: Gaussians) -> int | None:
    """Of the .spz that `abcd export --frame nerfstudio` writes; None where there is none: gaussforge is not
    there, or nothing to pack, or more than MOST_AT_ONCE."""
    kept = gaussians[shows(gaussians.opacities)]
    if not 0 < len(kept) <= MOST_AT_ONCE:
        return None
    try:
        check_installed()
        return len(packed("spz", Content(len(kept), kept.sh_degree, [kept])))
    except UserError:
        return None
