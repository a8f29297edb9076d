"""What a mesh of `abcd mesh` looks like, how far from it the points of the photos' model lie, and how it
turns from the planes through these.

    python -m benchmarks.mesh outputs/SCENE/METHOD/TIME castle.ply --data SCENE --view 3 --out mesh.png

The picture: a training photo, the mesh from the same camera in its colours, and in the light of a lamp beside
the camera. Rays are open3d's, on the CPU. The mesh must be in the data's frame.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import open3d
import torch
import tyro
from open3d import core
from PIL import Image
from scipy.spatial import cKDTree

from abcd_ns.cli.export.command import to_data
from abcd_ns.cli.report.run_folder import pipeline_config, read_settings
from abcd_ns.engine.types import View
from abcd_ns.nerfstudio.views import views_of

NEIGHBOURS = 16
LAMP = np.array([-0.4, -0.4, -0.8])
"""Towards it, from what is lit, in the camera's frame."""


def pictures(
    surface: open3d.geometry.TriangleMesh, scene: open3d.t.geometry.RaycastingScene, view: View, by: int
) -> list[np.ndarray]:
    """Float [h, w, 3], 0..1: the mesh in its colours and in grey; white where it is not."""
    K = view.K.double().numpy() * [[by], [by], [1.0]]
    matrices = core.Tensor(K), core.Tensor(view.viewmat.double().numpy())
    rays = scene.create_rays_pinhole(*matrices, view.width * by, view.height * by)
    hit = {name: value.numpy() for name, value in scene.cast_rays(rays).items()}
    there, (u, v) = np.isfinite(hit["t_hit"])[..., None], np.moveaxis(hit["primitive_uvs"], -1, 0)[..., None]
    corners = np.asarray(surface.triangles)[np.where(there[..., 0], hit["primitive_ids"], 0)]
    shares = np.stack((1 - u - v, u, v), axis=-2)
    color = (np.asarray(surface.vertex_colors)[corners] * shares).sum(axis=-2)
    normals = hit["primitive_normals"] @ view.viewmat[:3, :3].T.double().numpy()
    lit = np.abs(normals @ LAMP) / (np.linalg.norm(normals, axis=-1) + 1e-9)
    grey = np.repeat(0.1 + 0.75 * lit[..., None], 3, axis=-1)
    return [np.where(there, picture, 1.0) for picture in (color, grey)]


def main(
    run: Annotated[Path, tyro.conf.Positional],
    mesh: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    data: Path,
    view: int,
    out: Path,
    by: int = 1,
    colors: int = 96,
) -> None:
    """Write the picture, and print the distances.

    Args:
        view: which training view.
        by: how many pixels wide and high a pixel of the photo becomes.
        colors: of the picture's palette.
    """
    capture = pipeline_config(run, read_settings(run), data).datamanager.setup(device="cpu", test_mode="test")
    dataset, to = capture.train_dataset, to_data(run)
    surface = open3d.io.read_triangle_mesh(str(mesh))
    vertices = to.inverse.points(torch.from_numpy(np.asarray(surface.vertices)))
    surface.vertices = open3d.utility.Vector3dVector(vertices.numpy())
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(surface))
    camera = views_of(dataset.cameras)[view]
    photo = Image.fromarray(dataset.photos.image(view).numpy()[..., :3])
    photo = photo.resize((camera.width * by, camera.height * by), Image.Resampling.LANCZOS)
    drawn = [(255 * part).round().astype(np.uint8) for part in pictures(surface, scene, camera, by)]
    picture = Image.fromarray(np.concatenate([np.asarray(photo), *drawn], axis=1))
    picture.quantize(colors, dither=Image.Dither.NONE).save(out, optimize=True)
    points = dataset.metadata["points3D_xyz"].numpy()
    closest = scene.compute_closest_points(core.Tensor(points))
    off = np.linalg.norm(closest["points"].numpy() - points, axis=1) * to.scale
    half, most = np.quantile(off, [0.5, 0.9])
    print(f"{len(off):,} points: half are within {half:.3g} of the mesh, nine of ten within {most:.3g}")
    turned = angles(closest["primitive_normals"].numpy(), points)
    print(
        f"where it is closest to these, half of it is within {np.median(turned):.3g} degrees of their planes"
    )


def angles(normals: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Degrees between each normal and that of the plane through a point's neighbours: across it is the
    thinnest principal axis of these NEIGHBOURS points."""
    _, near = cKDTree(points).query(points, k=NEIGHBOURS)
    off = points[near] - points[near].mean(axis=1, keepdims=True)
    across = np.linalg.eigh(np.swapaxes(off, 1, 2) @ off)[1][..., 0]
    cosines = np.abs((across * normals).sum(axis=1)) / (np.linalg.norm(normals, axis=1) + 1e-12)
    return np.degrees(np.arccos(cosines.clip(0, 1)))


if __name__ == "__main__":
    tyro.cli(main)
