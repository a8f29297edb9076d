"""How large the files of a scene would be; none is written."""

from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.packed import BYTES_AT_ONCE, check_installed, packed
from abcd_ns.formats.ply import columns, header
from abcd_ns.formats.scene_file import shows

MOST_AT_ONCE = 4 * 2**30 // BYTES_AT_ONCE
"""Gaussians that are packed only to see how small they become: 4 GiB of RAM."""


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
        return len(packed(len(kept), kept.sh_degree, "spz", [kept]))
    except UserError:
        return None
