"""How large the files of a scene would be; none is kept."""

import tempfile
from pathlib import Path

import torch

from abcd_ns.engine.render.splat_kernels import MIN_ALPHA
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.packed import BYTES_AT_ONCE, check_installed, write_packed
from abcd_ns.formats.ply import columns, header

MOST_AT_ONCE = 4 * 2**30 // BYTES_AT_ONCE
"""Gaussians that are packed only to see how small they become: 4 GiB of RAM."""


def ply_bytes(gaussians: Gaussians) -> int:
    """Of the .ply that `abcd export` writes."""
    degree, count = gaussians.sh_degree, len(exported(gaussians))
    return len(header(count, degree)) + 4 * len(columns(degree)) * count


def spz_bytes(gaussians: Gaussians) -> int | None:
    """Of the .spz that `abcd export` writes; None where there is none: gaussforge is not there, or nothing to
    pack."""
    kept = exported(gaussians)
    if not len(kept):
        return None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.spz"
        try:
            check_installed()
            write_packed(path, len(kept), kept.sh_degree, "spz", [kept])
        except UserError:
            return None
        return path.stat().st_size


def exported(gaussians: Gaussians) -> Gaussians:
    """Those that some rasterizer would show."""
    return gaussians[torch.sigmoid(gaussians.opacities[:, 0]) >= MIN_ALPHA]
