"""The .ply file of 3D Gaussian Splatting, written part by part: no more than a part is ever in memory."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from abcd_ns.engine.types import Gaussians


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
    return np.concatenate([value.float().cpu().numpy() for value in values], axis=1)


@contextmanager
def ply_file(path: Path, count: int, sh_degree: int, comment: str) -> Iterator[Callable[[Gaussians], None]]:
    """Yields what takes the next Gaussians; the file appears under its name once all are in it.

    Args:
        count: how many there will be; the header says so, and comes first.
    """
    header = ["ply", "format binary_little_endian 1.0", f"comment {comment}", f"element vertex {count}"]
    header += [f"property float {name}" for name in columns(sh_degree)]
    partial, written = path.with_name(path.name + ".part"), 0
    try:
        with partial.open("wb") as file:

            def append(gaussians: Gaussians) -> None:
                nonlocal written
                written += len(gaussians)
                file.write(np.ascontiguousarray(rows(gaussians), dtype="<f4").tobytes())

            file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii", "replace"))
            yield append
        if written != count:
            raise RuntimeError(f"{path}: {written} Gaussians, where {count} were announced")
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
