"""From a folder to cameras, points and photos: what `ns-train abcd --data DIR` takes."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import (
    DataParser,
    DataparserOutputs,
    transform_poses_to_original_space,
)
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.data.utils.dataparsers_utils import get_train_eval_split_fraction
from torch import Tensor

from abcd_ns.data import OPTION
from abcd_ns.data.dataset import PHOTOS, pinhole_cameras
from abcd_ns.data.input_errors import InputError, one_line, say
from abcd_ns.data.prepare import Prepared, SceneOptions, prepare
from abcd_ns.nerfstudio.flags import shown


@shown("downscale_factor", "colmap_path", "images_path", "masks_path", "eval_mode", "eval_interval")
@dataclass
class AbcdDataParserConfig(SceneOptions):
    """A folder with a COLMAP model or a transforms.json, and photos. `--data DIR` alone is enough."""

    _target: type = field(default_factory=lambda: AbcdDataParser)
    """target class to instantiate"""
    eval_mode: Literal["auto", "interval", "fraction", "sector", "all"] = "auto"
    """Which photos are held out. auto follows the data's own lists, and is interval without any.
    interval: every n-th by name, see `eval_interval`. all: none, all are trained on and evaluated.
    fraction: a tenth, evenly spaced, as nerfstudio-data does.
    sector: one in n again, but all from one place, at an end of where the photos were taken."""
    eval_interval: int = 8
    """Photos 0, n, 2n, ... by name are held out; at least 2."""
    train_split_fraction: float = 0.9
    """Share of the views that is trained on by "fraction"."""
    as_stored: tyro.conf.Suppress[bool] = False
    """Return the cameras of the files, distortion included, for methods of nerfstudio's own."""


@dataclass
class AbcdDataparserOutputs(DataparserOutputs):
    """Transforms back to original coordinates in float64: geo-referenced ones need the digits."""

    def transform_poses_to_original_space(
        self, poses: Float[Tensor, "n 3 4"], camera_convention: Literal["opengl", "opencv"] = "opencv"
    ) -> Float[Tensor, "n 3 4"]:
        """As nerfstudio's, in float64."""
        return transform_poses_to_original_space(
            poses.double(), self.dataparser_transform.double(), self.dataparser_scale, camera_convention
        )


class AbcdDataParser(DataParser):
    """Reads the scene at the first call for a split; constructing it touches no file."""

    config: AbcdDataParserConfig

    def __init__(self, config: AbcdDataParserConfig):
        super().__init__(config)
        self.downscale_factor: int | None = None
        """nerfstudio sets 1 where a trained scene is viewed or exported: photos may then be absent."""
        self.tells = True  # whether what was noticed is printed when the scene is read
        self._prepared: Prepared | None = None

    @property
    def factor(self) -> int:
        """By which the photos' width and height are divided."""
        return self.prepared().factor

    def prepared(self) -> Prepared:
        """The whole scene, read at the first call; an InputError lists all bad files."""
        if self._prepared is None:
            options = self.config
            if options.as_stored and options.downscale_factor is None:
                options = replace(options, downscale_factor=1)
            self._prepared = prepare(options, needs_photos=self.downscale_factor is None)
            for note in (*self._prepared.chosen, *self._prepared.scene.notes) if self.tells else ():
                say(one_line(note), "yellow")
        return self._prepared

    def rows(self, split: str) -> list[int]:
        """Rows of the prepared scene's lists that belong to a split; see `split_rows`."""
        scene = self.prepared().scene
        if scene.split_lists and self.config.eval_mode == "auto":
            return scene.split_lists.rows([frame.name for frame in scene.frames], split)
        centers = np.stack([frame.camera_to_world[:3, 3] for frame in scene.frames])
        return split_rows(centers, split, self.config)

    def _generate_dataparser_outputs(self, split: str = "train", **_kwargs: Any) -> AbcdDataparserOutputs:
        prepared, rows, as_stored = self.prepared(), self.rows(split), self.config.as_stored
        sources = [prepared.sources[row] for row in rows]
        masks = [source.mask_path for source in sources if source.mask_path]
        if as_stored and 0 < len(masks) < len(sources):
            raise InputError(f"{self.config.data}: only ABCD's methods take masks for some of the photos.")
        original = prepared.similarity.after(prepared.scene.applied_transform, prepared.scene.applied_scale)
        return AbcdDataparserOutputs(
            image_filenames=[source.path for source in sources],
            cameras=stored_cameras(prepared, rows) if as_stored else _cameras(prepared, rows),
            scene_box=SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3])),
            mask_filenames=masks if len(masks) == len(sources) > 0 else None,
            metadata={**({} if as_stored else {PHOTOS: sources}), **prepared.points},
            dataparser_transform=torch.from_numpy(original.matrix),
            dataparser_scale=original.scale,
        )


def split_rows(centers: Float[np.ndarray, "n 3"], split: str, config: AbcdDataParserConfig) -> list[int]:
    """Rows of the name-sorted views, by their camera centers, that belong to "train", or to "val" or "test".
    An InputError if eval_interval is below 2, or a split would be empty."""
    count = len(centers)
    if config.eval_mode == "all":
        return list(range(count))
    if config.eval_mode == "fraction":
        trained, held_out = get_train_eval_split_fraction(range(count), config.train_split_fraction)
        if not 0 < len(trained) < count:
            raise InputError(
                f"{OPTION}train-split-fraction {config.train_split_fraction} parts {count} views into "
                f"{len(trained)} to train on and {len(held_out)} to hold out; neither may be 0."
            )
        return (trained if split == "train" else held_out).tolist()
    if config.eval_interval < 2:
        least = "must be 2 or more; or set eval-mode all"
        raise InputError(f"{OPTION}eval-interval {config.eval_interval} {least}.")
    held_out = range(0, count, config.eval_interval)
    if config.eval_mode == "sector":
        held_out = sector(centers, len(held_out))
    return [row for row in range(count) if (row in held_out) == (split != "train")]


def sector(centers: Float[np.ndarray, "n 3"], count: int) -> frozenset[int]:
    """`count` rows: the outermost camera along the longest axis, and those nearest to it."""
    offsets = centers - centers.mean(axis=0)
    _, _, axes = np.linalg.svd(offsets, full_matrices=False)
    outermost = int(np.abs(offsets @ axes[0]).argmax())
    away = np.linalg.norm(centers - centers[outermost], axis=1)
    return frozenset(np.argsort(away, kind="stable")[:count].tolist())


def _cameras(prepared: Prepared, rows: list[int]) -> Cameras:
    """Cameras [len(rows)] of reduced, undistorted photos."""
    poses = np.stack([prepared.scene.frames[row].camera_to_world for row in rows])
    poses = torch.from_numpy(prepared.similarity.poses(poses))
    return pinhole_cameras([prepared.lenses[row] for row in rows], poses)


def stored_cameras(prepared: Prepared, rows: list[int]) -> Cameras:
    """The cameras [len(rows)] of the files, distortion included; an InputError if nerfstudio has no such."""
    lenses = []
    for source, frame in ((prepared.sources[row], prepared.scene.frames[row]) for row in rows):
        if source.stored != source.reduced:
            raise InputError(
                f"{source.path} is {source.stored[0]} x {source.stored[1]} px, and only ABCD's methods "
                "reduce photos as they read them: give --downscale-factor 1."
            )
        lenses.append(frame.lens.resized(*source.stored))
    cameras = pinhole_cameras(lenses, _cameras(prepared, rows).camera_to_worlds)
    padded = [(*lens.distortion, *[0.0] * (8 - len(lens.distortion))) for lens in lenses]
    if any(any(row[5:]) for row in padded):
        raise InputError(f"{prepared.scene.model}: only ABCD's methods undistort FULL_OPENCV cameras.")
    order = [[0, 1, 2, 3, 5, 5] if lens.fisheye else [0, 1, 4, 5, 2, 3] for lens in lenses]
    cameras.distortion_params = torch.tensor(
        [[row[k] for k in places] for row, places in zip(padded, order, strict=True)], dtype=torch.float32
    )
    kinds = [CameraType.FISHEYE if lens.fisheye else CameraType.PERSPECTIVE for lens in lenses]
    cameras.camera_type = torch.tensor([[kind.value] for kind in kinds])
    return cameras
