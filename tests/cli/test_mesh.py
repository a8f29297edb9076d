"""`abcd mesh`: the surface of a scene whose surface is known, with no seam between the parts of space."""

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData
from torch import Tensor

from abcd_ns.cli.export import TRANSFORMS
from abcd_ns.cli.mesh.command import mesh
from abcd_ns.cli.mesh.depth_maps import DepthMaps
from abcd_ns.cli.mesh.fusion import Fusion, Piece, weld, without_specks
from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.layers.layer_renderer import LayerRenderer, RenderSettings
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.run.settings import flat_options, write_settings
from abcd_ns.run.store import MadeFor
from tests.cli.test_export import positions, write_store
from tests.nerfstudio.test_training import configure
from tests.reference.colmap_scene import LEFT, RIGHT, write_scene
from tests.reference.scenes import ring_of_views

VOXEL = 0.03


def surface_of(means: Tensor, size: float, colors: Tensor) -> Gaussians:
    """Opaque balls on a surface."""
    count = len(means)
    return Gaussians(
        means=means.float(),
        scales=torch.full((count, 3), math.log(size)),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4).clone(),
        features_dc=(colors.float() - 0.5) / SH_C0,
        features_rest=torch.zeros(count, 15, 3),
        opacities=torch.full((count, 1), 6.0),
    )


def sphere(count: int = 20_000) -> Gaussians:
    """Of radius 1, red above z = 0 and blue below: points along a spiral."""
    z = 1 - 2 * (torch.arange(count) + 0.5) / count
    angle = torch.arange(count) * math.pi * (3 - math.sqrt(5))
    across = (1 - z.square()).sqrt()
    colors = torch.where(z[:, None] > 0, torch.tensor([1.0, 0, 0]), torch.tensor([0, 0, 1.0]))
    return surface_of(torch.stack((across * angle.cos(), across * angle.sin(), z), dim=1), 0.015, colors)


def depth_maps(folder: Path, scene: Gaussians, views: list[View], median: bool = False) -> DepthMaps:
    """Drawn from two blocks, one after the other."""
    parted = MemoryScene(build_kd(scene.means, 2), scene)
    renderer = LayerRenderer(parted, TorchRasterizer(), ownership="fragments", pass_gaussians=0)
    assert len(renderer.nodes()) == 2
    return DepthMaps(folder, renderer, RenderSettings(sh_degree=3), views, median)


@pytest.fixture(scope="module", params=["expected", "median"])
def maps(request, tmp_path_factory) -> DepthMaps:
    """The sphere from around it."""
    views = ring_of_views(8, width=96, height=72)
    return depth_maps(tmp_path_factory.mktemp("maps"), sphere(), views, request.param == "median")


def fused(maps: DepthMaps, part_boxes: int) -> tuple[list[int], Piece]:
    """Of each part, how many boxes are in RAM; and the surface."""
    boxes = []

    class Watched(Fusion):
        def _grid(self, count: int) -> Any:
            boxes.append(count)
            return super()._grid(count)

    fusion = Watched(maps, VOXEL, part_boxes)
    surface = weld(list(fusion.pieces()))
    assert len(boxes) == 1 + fusion.parts  # the first one is empty
    return boxes[1:], surface


def triangles(surface: Piece) -> np.ndarray:
    """Float32 [m, 9], the faces in an order that is theirs alone."""
    corners = surface.vertices[surface.faces].reshape(-1, 9)
    return corners[np.lexsort(corners.T)]


def test_a_sphere_is_found_where_it_is_and_in_its_colours(maps):
    _, surface = fused(maps, 4096)
    off = np.linalg.norm(surface.vertices, axis=1) - 1
    # The balls are half a voxel thick; views that graze the sphere see it a little before it is there.
    assert np.abs(off).mean() < 1.5 * VOXEL
    assert np.abs(off).max() < 4 * VOXEL
    above, below = (surface.colors[sign * surface.vertices[:, 2] > 0.1] for sign in (1, -1))
    assert np.abs(above - [1, 0, 0]).mean() < 0.05
    assert np.abs(below - [0, 0, 1]).mean() < 0.05


@pytest.mark.parametrize("maps", ["expected"], indirect=True)
def test_parts_make_the_same_surface_bit_for_bit_and_a_part_at_a_time_is_in_ram(maps):
    whole, at_once = fused(maps, 4096)
    parts, welded = fused(maps, 8)
    assert np.array_equal(triangles(at_once), triangles(welded))
    assert len(at_once.vertices) == len(welded.vertices)
    assert len(whole) == 1
    assert max(parts) < whole[0] / 2  # a part, and what is around it
    edges = np.sort(welded.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert np.unique(edges, axis=0, return_counts=True)[1].max() == 2


@pytest.mark.parametrize("maps", ["expected"], indirect=True)
def test_what_is_transparent_or_far_away_leaves_no_surface(maps, tmp_path):
    assert list(Fusion(maps, VOXEL / 100).pieces()) == []
    scene = sphere()
    scene.opacities[:] = -5.0
    assert not len(depth_maps(tmp_path, scene, maps.views[:2]).footprints())


def test_specks_are_left_out():
    corners, face = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]])
    strip = [Piece(corners + np.array([k, 0, 0], np.float32), corners, face) for k in range(2000)]
    speck = Piece(corners + np.float32(5000), corners, face)
    assert len(without_specks(weld([*strip, speck])).faces) == 2000


# -- the command -------------------------------------------------------------------------------------------


def write_run(place: Path, **header: Any) -> Path:
    """A run's folder, as far as meshes go, beside its data: the wall of the photos, at z = 0 in the data's
    frame."""
    config, folder = configure(write_scene(place / "wall"), place / "out"), place / "run"
    (folder / "abcd").mkdir(parents=True)
    write_settings(config, flat_options(config), folder / "abcd")
    outputs = config.pipeline.datamanager.reader().setup().get_dataparser_outputs("train")
    outputs.save_dataparser_transform(folder / TRANSFORMS)
    to_run = Similarity.of(outputs.dataparser_transform, outputs.dataparser_scale)
    x, y = torch.meshgrid(torch.arange(-3, 3, 0.08), torch.arange(-2, 2, 0.08), indexing="xy")
    means = torch.stack((x.flatten(), y.flatten(), torch.zeros(x.numel())), dim=1)
    colors = torch.where(means[:, :1] > 0, torch.tensor(RIGHT) / 255, torch.tensor(LEFT) / 255)
    write_store(folder, to_run.gaussians(surface_of(means, 0.05, colors)), 2, **header)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return write_run(tmp_path_factory.mktemp("place"))


def read(path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    found = PlyData.read(str(path))
    vertices = found["vertex"].data
    color = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1)
    return positions(vertices), color, np.stack(found["face"].data["vertex_indices"])


def test_the_wall_is_in_the_datas_frame_and_another_reader_finds_it(run, tmp_path, capsys):
    assert mesh(run, data=run.parent / "wall", out=tmp_path / "wall.ply") == 0
    position, color, faces = read(tmp_path / "wall.ply")
    assert np.abs(position[:, 2]).max() < 0.1
    assert np.ptp(position[:, 0]) > 4
    assert faces.max() == len(position) - 1
    right = position[:, 0] > 0.3
    assert np.abs(color[right].mean(axis=0) - RIGHT).max() < 12
    said = capsys.readouterr().out
    assert f"{len(position):,} vertices, {len(faces):,} faces" in said
    assert "voxels of 0.2" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["wall.ply"]


def test_voxel_and_box_are_in_the_units_of_the_frame(run, tmp_path, capsys):
    options = {"data": run.parent / "wall", "voxel": 0.15, "box": (0.0, -1.0, -1.0, 1.0, 1.0, 1.0)}
    assert mesh(run, out=tmp_path / "box.ply", **options) == 0
    assert "voxels of 0.15" in capsys.readouterr().out
    position, _, _ = read(tmp_path / "box.ply")
    assert position[:, :2].min(axis=0) == pytest.approx([0, -1], abs=0.15)
    assert position[:, :2].max(axis=0) == pytest.approx([1, 1], abs=0.15)


def test_wrong_requests_are_refused_and_leave_nothing(run, tmp_path, monkeypatch):
    out, photos = tmp_path / "new.ply", run.parent / "wall"
    for words, options in {
        "it must be above 0": {"voxel": -1.0},
        "no surface in this box": {"box": (90.0, 90.0, 90.0, 91.0, 91.0, 91.0)},
        "no surface that three views see": {"voxel": 1e-3},
    }.items():
        with pytest.raises(UserError, match=words):
            mesh(run, **{"data": photos, "out": out, **options})
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(UserError, match="open3d, which fuses depths, is not there"):
        mesh(run, data=photos, out=out)
    assert list(tmp_path.iterdir()) == []


def test_the_photos_of_another_run_are_refused(tmp_path):
    run = write_run(tmp_path, **MadeFor("0", [0.0, 0.0, 0.0], "in turn", 3, "3dgs").header())
    with pytest.raises(UserError, match="is not what the run was made for: photos 0, not "):
        mesh(run, data=run.parent / "wall", out=tmp_path / "new.ply")
