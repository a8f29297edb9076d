"""`abcd mesh`: a trained scene's surface as a mesh of triangles."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal

import numpy as np
import torch
import tyro

from abcd_ns.cli.export import Box, check_request, stored, tell_rounding, to_data
from abcd_ns.cli.paths import find_run
from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.store.atomic import replacing
from abcd_ns.errors import UserError
from abcd_ns.run import SETTINGS_FILE, STORE
from abcd_ns.units import bytes_in_words

STAY = Similarity(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64), 1.0)


def mesh(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    data: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")],
    voxel: Annotated[float | None, tyro.conf.arg(metavar="SIDE", help_behavior_hint="")] = None,
    box: Annotated[Box | None, tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="")] = None,
    frame: Literal["data", "nerfstudio"] = "data",
    depth: Literal["median", "expected"] = "median",
) -> int:
    """Write a trained scene's surface as a mesh: a .ply of triangles with a colour at each corner.

    abcd mesh outputs/garden/abcd/TIME --data garden --out garden.ply

    Renders the depth of every training view and fuses the depths on a grid of voxels, one part of space after
    the other. RAM holds one part and the mesh.

    Args:
        run: Folder of the run, outputs/SCENE/METHOD/TIME.
        data: Folder of the run's photos, as given to `ns-train`. Cameras are read from there.
        out: A new file that ends in .ply.
            Until it is complete, 7 bytes for each pixel of all training views lie beside it.
        voxel: Side of the voxels, in the units of `frame`. Smaller voxels show more detail and more noise.
            Left out, twice the median width of a pixel on the surface.
        box: Keep only what lies in this box, in the coordinates of `frame`.
        frame: "data" has the coordinates and scale of the photos' poses, as in COLMAP or transforms.json.
            "nerfstudio" has those of the run, its viewer and `ns-export`.
        depth: Depth of a pixel. "median" is where half of it is covered.
            "expected" is the mean, which floaters in front of a wall move off the wall.
    """
    _check(out, voxel, box)
    run = find_run(find_run(run, SETTINGS_FILE), STORE)
    to = to_data(run) if frame == "data" else STAY
    from abcd_ns.cli.mesh.depth_maps import DepthMaps, open_views  # these load nerfstudio, in seconds
    from abcd_ns.cli.mesh.fusion import fuse, without_specks, write_ply
    from abcd_ns.cli.report.run_folder import pipeline_config

    with stored(run) as store, TemporaryDirectory(prefix=".abcd-mesh-", dir=out.parent) as folder:
        maps = DepthMaps(Path(folder), *open_views(store, pipeline_config(run, data)), depth == "median")
        surface, side = fuse(maps, voxel and voxel / to.scale, box, to)
        if not len(surface.faces):
            raise UserError("There is no surface" + (" in this box." if box else " that three views see."))
        surface = without_specks(surface)
        vertices = to.points(torch.from_numpy(surface.vertices)).numpy()
        with replacing(out) as partly:
            write_ply(partly, replace(surface, vertices=vertices))
    size, faces = bytes_in_words(out.stat().st_size), len(surface.faces)
    print(f"{out}: {len(vertices):,} vertices, {faces:,} faces, {size}, voxels of {side * to.scale:.3g}")
    tell_rounding(".ply", float(np.abs(vertices).max()), float(np.ptp(vertices, axis=0).max()))
    return 0


def _check(out: Path, voxel: float | None, box: Box | None) -> None:
    check_request(out, box)
    if out.suffix.lower() != ".ply":
        raise UserError(f"--out {out} must end in .ply.")
    if voxel is not None and not 0 < voxel < float("inf"):
        raise UserError(f"--voxel is {voxel}; it must be above 0.")
    try:
        import open3d  # noqa: F401
    except (ImportError, OSError) as error:
        raise UserError(f"open3d, which fuses depths, is not there ({error}); see `abcd doctor`.") from None
