"""All that `abcd check` knows of a scene; findings and the summary are made from it."""

import hashlib
import os
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from PIL import ImageStat

from abcd_ns.data.photos import PhotoSource
from abcd_ns.data.picture_files import has_alpha, open_picture, orientation, undecodable
from abcd_ns.data.prepare import Prepared, check_masks
from abcd_ns.nerfstudio.dataparser import AbcdDataParser, AbcdDataParserConfig
from abcd_ns.nerfstudio.views import training_views
from abcd_ns.progress_bar import tracked

REDUCED = (64, 64)
"""JPEG photos are decoded at an eighth of their size, or a larger one of at least this many pixels."""
MOST_POINTS = 20_000  # of more points, an evenly spaced choice is projected


@dataclass(frozen=True)
class Look:
    """What one decoded photo shows."""

    brightness: float  # mean luma, 0 to 1; 0 where it could not be decoded
    orientation: int = 1  # EXIF orientation, 1 to 8
    alpha: bool = False
    error: str | None = None  # why it cannot be decoded, in the words of training


@dataclass(frozen=True)
class Visibility:
    """Counts of points, scaled up where only some were projected. Occlusion is ignored."""

    in_view: np.ndarray  # float64 [views]: points in each view's picture
    in_none: int  # points in no picture
    behind_all: int  # those of them that lie behind every camera
    depth: np.ndarray
    """float64 [views]: median camera z of the points in the picture, model units; NaN without any."""


@dataclass(frozen=True)
class Survey:
    """A scene that can be read. Lists and rows are in the order of the photos' names."""

    prepared: Prepared
    train: list[int]  # rows of the views that are trained on
    held_out: list[int]
    near: float  # the near plane that training takes, in its own units
    seen: Visibility
    looks: tuple[Look, ...]
    copies: list[list[int]]  # groups of rows with the same photo

    @property
    def names(self) -> list[str]:
        """Of the photos."""
        return [frame.name for frame in self.prepared.scene.frames]

    @cached_property
    def centers(self) -> np.ndarray:
        """Camera centres float64 [n, 3], model units."""
        return np.stack([frame.camera_to_world[:, 3] for frame in self.prepared.scene.frames])

    @property
    def points(self) -> np.ndarray:
        """The points that training begins with, float64 [m, 3], model units."""
        return self.prepared.points_in_model

    @property
    def photo_bytes(self) -> int:
        """All photos and masks, decoded."""
        return sum(
            source.size[0] * source.size[1] * ((4 if look.alpha else 3) + bool(source.mask_path))
            for source, look in zip(self.prepared.sources, self.looks, strict=True)
        )


def survey(data: Path, downscale: int | None) -> Survey:
    """Read a scene as training does, and decode all photos; InputError lists what training would refuse."""
    parser = AbcdDataParser(AbcdDataParserConfig(data=data, downscale_factor=downscale))
    parser.tells = False  # notes are among the findings
    prepared, outputs = parser.prepared(), parser.get_dataparser_outputs("train")
    check_masks(prepared.sources)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        looks = pool.map(look, prepared.sources)
        return Survey(
            prepared=prepared,
            train=parser.rows("train"),
            held_out=parser.rows("test"),
            near=training_views(outputs.cameras, outputs.metadata.get("points3D_xyz"))[0].near,
            seen=visibility(prepared),
            looks=tuple(tracked(looks, "Decoding photos", len(prepared.sources))),
            copies=copies(prepared.sources),
        )


def look(source: PhotoSource) -> Look:
    """Decode one photo."""
    try:
        with open_picture(source.path) as picture:
            turned, alpha = orientation(picture), has_alpha(picture)
            picture.draft("L", REDUCED)
            mask = picture.convert("RGBA").getchannel("A").point(lambda a: 255 * (a > 127)) if alpha else None
            visible = ImageStat.Stat(picture.convert("L"), mask)
            brightness = visible.mean[0] / 255 if visible.count[0] else 0.0
    except (OSError, SyntaxError, ValueError) as error:
        return Look(0.0, error=str(undecodable(source.path, error)))
    return Look(brightness, turned, alpha)


def copies(sources: Sequence[PhotoSource]) -> list[list[int]]:
    """Groups of rows whose files are the same, byte for byte. Only files of equal length are read."""
    by_length: dict[int, list[int]] = defaultdict(list)
    for row, source in enumerate(sources):
        by_length[source.path.stat().st_size].append(row)
    groups: dict[tuple[int, bytes], list[int]] = defaultdict(list)
    for length, rows in by_length.items():
        for row in rows if len(rows) > 1 else ():
            groups[length, hashlib.blake2b(sources[row].path.read_bytes()).digest()].append(row)
    return [rows for rows in groups.values() if len(rows) > 1]


def visibility(prepared: Prepared) -> Visibility:
    """Project the points into every final camera, in float64."""
    scene, points = prepared.scene, prepared.points_in_model
    step = -(-len(points) // MOST_POINTS) or 1
    factor, points = len(points) / max(len(points[::step]), 1), points[::step]
    ever_in, ever_ahead = np.zeros(len(points), bool), np.zeros(len(points), bool)
    in_view, depth = np.zeros(len(scene.frames)), np.full(len(scene.frames), np.nan)
    for row, (frame, lens) in enumerate(zip(scene.frames, prepared.lenses, strict=True)):
        pose = frame.camera_to_world
        # OpenGL cameras look along -z, with y upwards; pictures count rows downwards.
        x, y, z = ((points - pose[:, 3]) @ (pose[:, :3] * [1, -1, -1])).T
        ahead = z > 0
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        inside = ahead & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
        ever_in |= inside
        ever_ahead |= ahead
        in_view[row] = factor * inside.sum()
        if inside.any():
            depth[row] = np.median(z[inside])
    return Visibility(in_view, round(factor * (~ever_in).sum()), round(factor * (~ever_ahead).sum()), depth)
