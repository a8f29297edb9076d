"""The .ply file of 3D Gaussian Splatting, written part by part: no more than a part is ever in memory."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from abcd_ns import __version__
from abcd_ns.engine.types import Gaussians

GENERATOR = f"abcd_ns {__version__}"
ANTIALIASED = "comment antialiased"  # opacities are to be compensated for the low-pass filter


@dataclass(frozen=True)
class Content:
    """What is written into a file."""

    count: int  # Gaussians, in all
    sh_degree: int
    parts: Iterable[Gaussians]  # as they come
    antialiased: bool = False  # see ANTIALIASED; files are marked so


def columns(sh_degree: int) -> list[str]:
    """The properties of a vertex, all float32, in the order of the reference implementation of 3DGS."""
    rest = 3 * ((sh_degree + 1) ** 2 - 1)
    return [
        *("x", "y", "z", "nx", "ny", "nz"),
        *(f"f_dc_{channel}" for channel in range(3)),
        *(f"f_rest_{number}" for number in range(rest)),
        "opacity",
        *(f"scale_{axis}" for axis in range(3)),
        *(f"rot_{part}" for part in range(4)),
    ]


def rows(gaussians: Gaussians) -> np.ndarray:
    """float32 [n, c] for `columns`: normals are 0; all of a channel's harmonics stand together."""
    means = gaussians.means.float()
    values = (
        means,
        means.new_zeros(means.shape),
        gaussians.features_dc,
        gaussians.features_rest.transpose(1, 2).flatten(1),
        gaussians.opacities,
        gaussians.scales,
        gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True),
    )
    return np.concatenate([value.float().cpu().numpy() for value in values], axis=1).astype("<f4", copy=False)


def header(count: int, sh_degree: int, antialiased: bool = False) -> bytes:
    """What comes before the rows of `count` Gaussians."""
    lines = ["ply", "format binary_little_endian 1.0", f"comment {GENERATOR}"]
    lines += [ANTIALIASED] if antialiased else []
    lines += [f"element vertex {count}", *(f"property float {name}" for name in columns(sh_degree))]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "replace")


def pieces(content: Content) -> Iterator[bytes]:
    """The file, part by part."""
    yield header(content.count, content.sh_degree, content.antialiased)
    for gaussians in content.parts:
        yield rows(gaussians).tobytes()
