"""Depth maps to a surface: a truncated signed distance function on sparse voxels, one part of space at once.

Voxels come in boxes of BOX^3, and only boxes that a surface passes are there. The boxes are parted by a k-d
tree, and a part is fused with the boxes around it. A voxel's value depends on the views alone, so that it is
the same in each part that has it, and so are the vertices between voxels. Each face is kept by the one part
whose box it begins in: together the parts are, bit for bit, the surface that is fused at once.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import torch
from jaxtyping import Float64
from open3d import core
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from abcd_ns.cli.export import Box, inside
from abcd_ns.cli.mesh.depth_maps import DepthMaps
from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.types import View
from abcd_ns.errors import UserError
from abcd_ns.formats.ply import GENERATOR
from abcd_ns.progress_bar import ProgressBar, tracked

VOXEL_PIXELS = 2.0
"""The side of a voxel by default, in pixels as wide as most are where they meet the surface."""
MANY = 0.01  # share of the pixels that may be left out without a warning
BOX = 16  # side of a box, voxels
PART_BOXES = 4096
"""About as many as a part has, those around it left out: 0.3 GiB, and as much while vertices are found."""
TRUNCATION = 8.0
"""How far from what a view sees it has a say, voxels; open3d's own. Views that disagree by more than twice
that leave a hole."""
LEAST_VIEWS = 3  # that must see a place for it to be a part of the surface
STRIDE = 4  # open3d looks at every fourth pixel, each way, to see where boxes are needed
FAR = BOX / STRIDE  # voxels that a pixel may cover: with more, boxes would be missed
SPECK = 0.001  # clusters with fewer faces than this share of the largest one's are left out


@dataclass(frozen=True)
class Piece:
    """A part of the surface, or all of it."""

    vertices: np.ndarray  # [n, 3], world units; those between two pieces are in both, bit for bit
    colors: np.ndarray  # float32 [n, 3], 0..1
    faces: np.ndarray  # int64 [m, 3]


NOTHING = Piece(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))


class Fusion:
    """Fuses depth maps on voxels with sides of `voxel` world units. Begins by finding the boxes in which
    views see a surface, and parts them: about `part_boxes` a part, those around it left out."""

    def __init__(self, maps: DepthMaps, voxel: float, part_boxes: int = PART_BOXES) -> None:
        self._maps, self._voxel, self._seen = maps, voxel, list[np.ndarray]()
        grid, none = self._grid(1), np.zeros((0, 3), np.int32)
        for number, view in enumerate(tracked(maps.views, "looking for surfaces")):
            depth, found = maps.depth(number), none
            sampled = depth[::STRIDE, ::STRIDE]
            if ((sampled > 0) & (sampled < self._farthest(view))).any():
                boxes = grid.compute_unique_block_coordinates(_image(depth), *self._optics(view))
                found = np.unique(boxes.numpy(), axis=0)
            self._seen.append(found)
        self._boxes = np.unique(np.concatenate([none, *self._seen]), axis=0)
        self.parts = max(1, -(-len(self._boxes) // part_boxes))
        self._tree = build_kd(self._centers(self._boxes), self.parts)

    def pieces(self) -> Iterator[Piece]:
        """The surface, part by part."""
        with ProgressBar("fusing", self.parts * len(self._maps.views)) as bar:
            for part in range(self.parts):
                # A quarter of a box more, so that no rounding leaves out a neighbour.
                around = self._tree.cell(part).grown(1.25 * BOX * self._voxel)
                count = int(around.contains(self._centers(self._boxes)).sum())
                grid = self._grid(max(count, 1))
                for number, view in enumerate(self._maps.views):
                    boxes = self._seen[number][around.contains(self._centers(self._seen[number])).numpy()]
                    if len(boxes):
                        self._integrate(grid, number, view, boxes)
                    bar.advance()
                if count:
                    yield self._own(part, grid.extract_triangle_mesh(LEAST_VIEWS - 0.5))

    def _integrate(self, grid: Any, number: int, view: View, boxes: np.ndarray) -> None:
        color = self._maps.color(number).astype(np.float32) / 255
        intrinsic, *others = self._optics(view)
        images = _image(self._maps.depth(number)), _image(color)
        grid.integrate(core.Tensor(boxes), *images, intrinsic, intrinsic, *others)

    def _own(self, part: int, mesh: Any) -> Piece:
        """The faces that begin in a box of the part, with their vertices."""
        vertices, faces = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy().astype(np.int64)
        middles = vertices[faces].mean(axis=1, dtype=np.float64)
        boxes = np.floor(np.floor(middles / self._voxel) / BOX)
        own = (self._tree.assign(self._centers(boxes)) == part).numpy()
        return with_faces(Piece(vertices, mesh.vertex.colors.numpy(), faces), own)

    def _centers(self, boxes: np.ndarray) -> Float64[Tensor, "n 3"]:
        return torch.from_numpy((boxes.astype(np.float64) + 0.5) * (BOX * self._voxel))

    def _farthest(self, view: View) -> float:
        return FAR * self._voxel * float(view.K[0, 0])

    def _optics(self, view: View) -> tuple[Any, Any, float, float, float]:
        """Intrinsics, extrinsics, what a unit of depth is, the largest that counts, and the truncation."""
        matrices = (core.Tensor(matrix.double().cpu().numpy()) for matrix in (view.K, view.viewmat))
        return *matrices, 1.0, self._farthest(view), TRUNCATION

    def _grid(self, boxes: int) -> Any:
        return open3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(core.float32,) * 3,
            attr_channels=((1), (1), (3)),
            voxel_size=self._voxel,
            block_resolution=BOX,
            block_count=boxes,
        )


def _image(values: np.ndarray) -> Any:
    return open3d.t.geometry.Image(core.Tensor(values))


def fuse(maps: DepthMaps, voxel: float | None, box: Box | None, to: Similarity) -> tuple[Piece, float]:
    """The surface within the box, and the side of its voxels, in world units of the run."""
    footprints = maps.footprints()
    if not len(footprints):
        raise UserError("There is no surface: what the training views show is too transparent.")
    side = voxel or VOXEL_PIXELS * float(np.median(footprints))
    surface = weld([_within(box, to, piece) for piece in Fusion(maps, side).pieces()])
    if (far := float((footprints > FAR * side).mean())) > MANY:
        print(f"{far:.0%} of the pixels show what is too far for such voxels; a larger --voxel takes it in.")
    return surface, side


def _within(box: Box | None, to: Similarity, piece: Piece) -> Piece:
    """The faces whose middles are in the box, if there is one, in the frame `to`."""
    if box is None:
        return piece
    middles = to.points(torch.from_numpy(piece.vertices[piece.faces].mean(axis=1, dtype=np.float64)))
    return with_faces(piece, inside(box, middles).numpy())


def weld(pieces: Sequence[Piece]) -> Piece:
    """All pieces as one: vertices with the same position, bit for bit, become one."""
    pieces = [NOTHING, *pieces]
    vertices = np.concatenate([piece.vertices for piece in pieces])
    colors = np.concatenate([piece.colors for piece in pieces])
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=False)])
    rows = np.ascontiguousarray(vertices).view(np.dtype((np.void, 12)))[:, 0]
    _, first, which = np.unique(rows, return_index=True, return_inverse=True)
    return Piece(vertices[first], colors[first], which[faces])


def without_specks(mesh: Piece) -> Piece:
    """The mesh without its smallest clusters of faces, see SPECK."""
    count = len(mesh.vertices)
    ends = mesh.faces[:, :2].T, mesh.faces[:, 1:].T
    row, column = np.concatenate(ends, axis=1)
    edges = coo_matrix((np.ones(len(row), bool), (row, column)), shape=(count, count))
    cluster = connected_components(edges, directed=False)[1][mesh.faces[:, 0]]
    sizes = np.bincount(cluster)
    return with_faces(mesh, sizes[cluster] >= SPECK * sizes.max())


def with_faces(mesh: Piece, kept: np.ndarray) -> Piece:
    """Only these faces, and the vertices that they need."""
    used, faces = np.unique(mesh.faces[kept], return_inverse=True)
    return Piece(mesh.vertices[used], mesh.colors[used], faces.reshape(-1, 3))


def write_ply(path: Path, mesh: Piece) -> None:
    """Binary, with a colour for each vertex."""
    vertices = np.empty(len(mesh.vertices), [("position", "<f4", 3), ("color", "u1", 3)])
    vertices["position"], vertices["color"] = mesh.vertices, (mesh.colors * 255).round()
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"comment {GENERATOR}"]
    lines += [f"element vertex {len(vertices)}", *(f"property float {axis}" for axis in "xyz")]
    lines += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode())
        file.write(vertices.tobytes())
        file.write(faces.tobytes())
