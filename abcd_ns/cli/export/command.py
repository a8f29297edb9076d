"""`abcd export`: a trained scene as .ply files, whole, by block, or within a box."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from rich.console import Console
from rich.progress import track

from abcd_ns import __version__
from abcd_ns.cli.export.ply import ply_file
from abcd_ns.cli.export.shown import Box, Shown
from abcd_ns.engine.gaussians.frames import Frame
from abcd_ns.engine.store import ParameterStore, StoreError
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.run import STATE, STORE

TRANSFORMS = "dataparser_transforms.json"
"""nerfstudio's file that tells how the data's frame became the run's."""
LOST_DIGITS = 1e-4
"""A rounding error that is worth a word: this share of the scene's size."""


def export(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")],
    by_block: bool = False,
    box: Annotated[Box | None, tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="")] = None,
    frame: Literal["data", "nerfstudio"] = "data",
) -> int:
    """Write a trained scene as .ply, as viewers of 3D Gaussian Splatting read it.

    abcd export outputs/garden/abcd/TIME --out garden.ply

    abcd export outputs/garden/abcd/TIME --out parts --by-block

    Reads the blocks at rest, one at a time, so that no scene is too large; also of a run that was stopped or
    killed. Gaussians that no rasterizer draws, being too transparent, are left out.

    Args:
        run: A run's folder, outputs/SCENE/METHOD/TIME.
        out: A new file; with --by-block a new folder, of which each file is a block.
        by_block: One file for each block.
        box: Only Gaussians with their means in this box, in the coordinates of `frame`.
        frame: "data" is that of the photos' poses, as COLMAP or transforms.json have them, with its scale;
            "nerfstudio" is that of the run, its viewer and `ns-export`.

    Raises:
        UserError: there is no run, it has nothing to show yet, or `out` exists or cannot be written.
    """
    _check(out, box)
    to = _to_data(run) if frame == "data" else None
    try:
        with _open(run / STATE / STORE) as store:
            scene = Shown(store, to, box)
            counts = {block: scene.count(block) for block in _steps(scene.blocks, "counting")}
            if not sum(counts.values()):
                raise UserError("There is no Gaussian to export" + (" in this box." if box else "."))
            written = _write_parts(scene, counts, out) if by_block else _write(scene, counts, out)
    except StoreError as error:
        raise UserError(f"{error} If the run is training, wait until it has ended.") from None
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror}.") from None
    _report(written, counts, scene)
    return 0


def _check(out: Path, box: Box | None) -> None:
    if out.exists():
        raise UserError(f"--out {out} exists already; choose another name.")
    if not out.absolute().parent.is_dir():
        raise UserError(f"{out.absolute().parent} does not exist; make it first.")
    if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise UserError("--box needs X0 < X1, Y0 < Y1 and Z0 < Z1.")


def _to_data(run: Path) -> Frame:
    """From the run's frame back to that of the data."""
    path = run / TRANSFORMS
    try:
        found = json.loads(path.read_text())
        matrix = torch.tensor(found["transform"], dtype=torch.float64).reshape(3, 4)
        return Frame(matrix[:, :3], matrix[:, 3], float(found["scale"])).inverse
    except FileNotFoundError:
        raise UserError(
            f"{run} has no {TRANSFORMS}; give the folder of a run, or --frame nerfstudio."
        ) from None
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise UserError(f"{path} cannot be read ({error}); use --frame nerfstudio.") from None


def _open(folder: Path) -> ParameterStore:
    if not folder.is_dir():
        raise UserError(f"There is no run of ABCD in {folder.parent.parent}: it has no {folder}.")
    return ParameterStore.open(folder, read_only=True)


def _write(scene: Shown, counts: dict[int, int], out: Path) -> list[Path]:
    with _file(scene, out, sum(counts.values())) as append:
        for block in _steps([block for block, count in counts.items() if count], "writing"):
            append(scene.gaussians(block))
    return [out]


def _write_parts(scene: Shown, counts: dict[int, int], out: Path) -> list[Path]:
    out.mkdir()
    written = []
    for block in _steps([block for block, count in counts.items() if count], "writing"):
        written.append(out / f"block-{block:04d}.ply")
        with _file(scene, written[-1], counts[block]) as append:
            append(scene.gaussians(block))
    return written


def _file(scene: Shown, path: Path, count: int) -> AbstractContextManager[Callable[[Gaussians], None]]:
    return ply_file(path, count, scene.sh_degree, f"abcd_ns {__version__}")


def _steps(blocks: Iterable[int], what: str) -> Iterator[int]:
    blocks = list(blocks)
    yield from track(blocks, what, console=Console(stderr=True), transient=True, disable=len(blocks) < 2)


def _report(written: Sequence[Path], counts: dict[int, int], scene: Shown) -> None:
    size = sum(path.stat().st_size for path in written) / 2**20
    where = written[0] if len(written) == 1 else f"{written[0].parent} ({len(written)} files)"
    print(f"{where}: {sum(counts.values()):,} Gaussians, {size:.1f} MiB")
    rounding = scene.largest * torch.finfo(torch.float32).eps
    if rounding > LOST_DIGITS * scene.size:
        print(
            f"The data's origin is far away: float32, which .ply has, rounds positions to {rounding:.1g}. "
            "--frame nerfstudio keeps all digits."
        )
