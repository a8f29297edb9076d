"""One mesh of many pieces: welded, without specks, written as .ply."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from abcd_ns.formats.ply import GENERATOR

SPECK = 0.001  # clusters with fewer faces than this share of the largest one's are left out


@dataclass(frozen=True)
class Piece:
    """A part of the surface, or all of it."""

    vertices: np.ndarray
    """[n, 3], world units; those between two pieces are in both, bit for bit."""
    colors: np.ndarray
    """float32 [n, 3], 0..1."""
    faces: np.ndarray
    """int64 [m, 3]."""


NOTHING = Piece(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))


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
