"""From a folder to cameras, points and photos: what `ns-train abcd --data DIR` takes."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import (
    DataParser,
    DataParserConfig,
    DataparserOutputs,
    transform_poses_to_original_space,
)
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from abcd_ns.plugin.data.colmap_model import MODEL_FOLDERS, find_model, read_colmap
from abcd_ns.plugin.data.normalize import Center, Orientation, Similarity, normalizing_similarity
from abcd_ns.plugin.data.photo_folders import PhotoFile, assume_photos, locate_photos
from abcd_ns.plugin.data.photos import PhotoSource
from abcd_ns.plugin.data.picture_files import check_regular
from abcd_ns.plugin.data.scene import Frame, Lens, Scene, check_layout
from abcd_ns.plugin.data.transforms_json import read_transforms
from abcd_ns.plugin.data.undistort import Undistortion, undistortion
from abcd_ns.plugin.input_errors import InputError, Problems, one_line

MIP_NERF_360 = ("bicycle", "bonsai", "counter", "flowers", "garden", "kitchen", "room", "stump", "treehill")


@dataclass
class AbcdDataParserConfig(DataParserConfig):
    """A folder with a COLMAP model or a transforms.json, and photos. `--data DIR` alone is enough."""

    _target: type = field(default_factory=lambda: AbcdDataParser)
    """target class to instantiate"""
    data: Path = Path()
    """A folder with sparse/0, colmap/sparse/0 or sparse (COLMAP, .bin or .txt) and images, or with
    transforms.json; or a transforms.json file itself. Where both are, COLMAP's model is taken."""
    downscale_factor: int = 1
    """Divides the photos' width and height. images_N is read where it fits the model; otherwise photos are
    reduced in memory by area averaging, to sizes rounded down, and nothing is written. Intrinsics follow
    the sizes: fx x new width / old width, fy x new height / old height."""
    scale_factor: float = 1.0
    """Multiplies the scene's size, after auto_scale_poses."""
    scene_scale: float = 1.0
    """Half the side of the scene box, in scaled units."""
    orientation_method: Orientation = "up"
    """How the scene is turned; "up" makes the mean of the cameras' up vectors +z."""
    center_method: Center = "poses"
    """What becomes the origin: the mean of the cameras, the point that they look at, or nothing."""
    auto_scale_poses: bool = True
    """Scale the scene until all camera coordinates lie within -1 to 1."""
    eval_mode: Literal["interval", "all"] = "interval"
    """"interval" holds out every eval_interval-th view; "all" trains and evaluates on all views."""
    eval_interval: int = 8
    """Views 0, n, 2n, ... of the list sorted by name are held out; at least 2."""


@dataclass
class AbcdDataparserOutputs(DataparserOutputs):
    """Keeps the way back to the original coordinates in float64: geo-referenced ones need the digits."""

    def transform_poses_to_original_space(
        self, poses: Float[Tensor, "n 3 4"], camera_convention: Literal["opengl", "opencv"] = "opencv"
    ) -> Float[Tensor, "n 3 4"]:
        """As nerfstudio's, in float64."""
        return transform_poses_to_original_space(
            poses.double(), self.dataparser_transform.double(), self.dataparser_scale, camera_convention
        )


@dataclass(frozen=True)
class _Prepared:
    """What all splits share."""

    scene: Scene
    sources: list[PhotoSource]
    lenses: list[Lens]
    """Final cameras: reduced, undistorted."""
    similarity: Similarity
    points: dict[str, Tensor]


class AbcdDataParser(DataParser):
    """Reads the scene at the first call for a split; constructing it touches no file.

    Raises (from `get_dataparser_outputs`):
        InputError: the input cannot be used; all bad files are listed.
    """

    config: AbcdDataParserConfig
    includes_time = False

    def __init__(self, config: AbcdDataParserConfig):
        super().__init__(config)
        self.downscale_factor: int | None = None
        """nerfstudio sets it to 1 where a trained scene is viewed or exported: photos may then be absent."""
        self._prepared: _Prepared | None = None

    def check(self) -> None:
        """Read the model and look at every photo, before anything costly is started; later calls reuse it.

        Raises:
            InputError: as `get_dataparser_outputs`.
        """
        for split in ("train", "test"):
            split_rows(len(self._load().sources), split, self.config)

    @property
    def largest_image(self) -> int:
        """Pixels of the largest photo as it is trained on."""
        return max(width * height for width, height in (source.size for source in self._load().sources))

    def _load(self) -> _Prepared:
        if self._prepared is None:
            self._prepared = _prepare(self.config, needs_photos=self.downscale_factor is None)
        return self._prepared

    def _generate_dataparser_outputs(self, split: str = "train", **_kwargs: Any) -> AbcdDataparserOutputs:
        prepared = self._load()
        rows = split_rows(len(prepared.sources), split, self.config)
        sources = [prepared.sources[row] for row in rows]
        masks = [source.mask_path for source in sources if source.mask_path]
        original = prepared.similarity.after(prepared.scene.applied_transform, prepared.scene.applied_scale)
        reach = self.config.scene_scale
        return AbcdDataparserOutputs(
            image_filenames=[source.path for source in sources],
            cameras=_cameras(prepared, rows),
            scene_box=SceneBox(aabb=torch.tensor([[-reach] * 3, [reach] * 3], dtype=torch.float32)),
            mask_filenames=masks or None,
            metadata={"photos": sources, **prepared.points},
            dataparser_transform=torch.from_numpy(original.matrix),
            dataparser_scale=original.scale,
        )


def split_rows(count: int, split: str, config: AbcdDataParserConfig) -> list[int]:
    """Rows of the name-sorted list of `count` views that belong to `split`.

    Args:
        split: "train", or "val" or "test" for the views held out.

    Raises:
        InputError: eval_interval below 2.
        ValueError: no such split.
    """
    if split not in ("train", "val", "test"):
        raise ValueError(f"There is no split {split}; there are train, val and test.")
    if config.eval_mode == "all":
        return list(range(count))
    if config.eval_interval < 2:
        raise InputError(
            f"--eval-interval is {config.eval_interval}; it must be at least 2, or --eval-mode all."
        )
    return [row for row in range(count) if (row % config.eval_interval == 0) == (split != "train")]


def read_scene(data: Path) -> Scene:
    """The model in `data`, COLMAP's before transforms.json.

    Raises:
        InputError: nothing there; says what was looked for, and where known scenes come from.
    """
    if data.suffix == ".json" and data.exists():
        return read_transforms(data)
    model, transforms = find_model(data), data / "transforms.json"
    if model is not None:
        scene = read_colmap(data, model)
        if transforms.exists():
            scene.notes.append(f"{model} is used; give --data {transforms} for the other.")
        return scene
    if transforms.exists():
        return read_transforms(transforms)
    if data.name in MIP_NERF_360:
        hint = f"download {data.name} from https://jonbarron.info/mipnerf360 and unpack it there."
    else:
        hint = "give a folder with a COLMAP model, or make one with `ns-process-data images`."
    if not data.exists():
        raise InputError(f"--data {data} does not exist; {hint}")
    looked = ", ".join(f"{folder}/cameras.bin|txt" for folder in MODEL_FOLDERS)
    raise InputError(f"--data {data} holds no model (looked for {looked} and transforms.json); {hint}")


def _prepare(config: AbcdDataParserConfig, needs_photos: bool) -> _Prepared:
    """Read and check everything, and say what the user should know."""
    factor = int(config.downscale_factor)
    if factor != config.downscale_factor or factor < 1:
        raise InputError(
            f"--downscale-factor is {config.downscale_factor}; it must be a whole number from 1."
        )
    scene = read_scene(config.data)
    check_layout(scene)
    files, notes = _find_photos(scene, factor, needs_photos)
    sources, lenses = _sources(scene, files)
    poses = np.stack([frame.camera_to_world for frame in scene.frames])
    similarity = normalizing_similarity(
        poses, config.orientation_method, config.center_method, config.auto_scale_poses, config.scale_factor
    )
    points, more = _points(scene, similarity)
    for note in scene.notes + notes + more:
        CONSOLE.print(one_line(note), style="yellow", markup=False, soft_wrap=True)
    return _Prepared(scene, sources, lenses, similarity, points)


def _find_photos(scene: Scene, factor: int, needed: bool) -> tuple[list[PhotoFile], list[str]]:
    problems = Problems()
    for frame in scene.frames:
        if frame.mask_path is not None:
            with problems.collect():
                check_regular(frame.mask_path)
    try:
        with problems.collect():
            files, notes = locate_photos(scene, factor)
        problems.raise_if_any()
    except InputError as error:
        if needed:
            raise
        files, notes = assume_photos(scene, factor), [f"Going on without photos: {error.lines[0]}"]
    return files, notes


def _sources(scene: Scene, files: list[PhotoFile]) -> tuple[list[PhotoSource], list[Lens]]:
    """Photo sources and final cameras. A lens without distortion is left alone, pixel for pixel."""
    flats, problems = {}, Problems()
    lenses = [frame.lens.resized(*file.reduced) for frame, file in zip(scene.frames, files, strict=True)]
    for frame, lens in zip(scene.frames, lenses, strict=True):
        if lens not in flats:
            flats[lens] = None
            with problems.collect():
                flats[lens] = _undistortion(frame, lens) if lens.distorted else None
    problems.raise_if_any()
    sources = [
        PhotoSource(file.path, file.stored, file.reduced, flats[lens], frame.mask_path)
        for frame, file, lens in zip(scene.frames, files, lenses, strict=True)
    ]
    return sources, [flats[lens].pinhole if flats[lens] else lens for lens in lenses]


def _undistortion(frame: Frame, lens: Lens) -> Undistortion:
    try:
        return undistortion(lens)
    except InputError as error:
        raise InputError(f"{frame.name}: {error}") from None


def _points(scene: Scene, similarity: Similarity) -> tuple[dict[str, Tensor], list[str]]:
    """Metadata as splatfacto expects it; without points it starts from random ones."""
    good = np.isfinite(scene.points_xyz).all(axis=1)
    notes = (
        [] if good.all() else [f"{scene.model}: {(~good).sum()} points with NaN or infinity are left out."]
    )
    if not good.any():
        return {}, [
            *notes,
            f"{scene.model} has no points: Gaussians start at random places, which costs quality.",
        ]
    xyz = similarity.points(scene.points_xyz[good]).astype(np.float32)
    rgb = np.ascontiguousarray(scene.points_rgb[good])
    return {"points3D_xyz": torch.from_numpy(xyz), "points3D_rgb": torch.from_numpy(rgb)}, notes


def _cameras(prepared: _Prepared, rows: list[int]) -> Cameras:
    """nerfstudio's cameras [len(rows)], perspective, without distortion, float32."""
    lenses = [prepared.lenses[row] for row in rows]
    poses = np.stack([prepared.scene.frames[row].camera_to_world for row in rows])

    def column(name: str, dtype: torch.dtype) -> Tensor:
        return torch.tensor([[getattr(lens, name)] for lens in lenses], dtype=dtype)

    return Cameras(
        camera_to_worlds=torch.from_numpy(prepared.similarity.poses(poses).astype(np.float32)),
        **{name: column(name, torch.float32) for name in ("fx", "fy", "cx", "cy")},
        **{name: column(name, torch.int64) for name in ("width", "height")},
        camera_type=CameraType.PERSPECTIVE,
    )
