"""Reads and checks everything that a scene consists of, once for all of its splits."""

import math
import os
import shlex
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from torch import Tensor

from abcd_ns.data import DOWNSCALE, OPTION
from abcd_ns.data.colmap_model import IMAGES, find_models, read_colmap
from abcd_ns.data.input_errors import InputError, Problems
from abcd_ns.data.normalize import Center, Orientation, Similarity, normalizing_similarity
from abcd_ns.data.photo_folders import as_stored, assume_photos, locate_photos
from abcd_ns.data.photos import Photos, PhotoSource
from abcd_ns.data.picture_files import SUFFIXES, read_size, visible_files
from abcd_ns.data.ply import GREY
from abcd_ns.data.scene import Lens, Scene, check_layout
from abcd_ns.data.transforms_json import TRANSFORMS, read_split_transforms, read_transforms
from abcd_ns.data.undistort import undistortion
from abcd_ns.progress_bar import tracked

MAX_AUTO_SIDE = 1600  # pixels along a photo's longer side: nerfstudio's MAX_AUTO_RESOLUTION
MIP_NERF_360 = ("bicycle", "bonsai", "counter", "flowers", "garden", "kitchen", "room", "stump", "treehill")
_MODEL_FILES = ("cameras.bin", "cameras.txt", f"{TRANSFORMS}.json", f"{TRANSFORMS}_train.json")
"""By which a model is found where nobody looks for it."""
_VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
_ARCHIVES = (".zip", ".gz", ".tgz", ".tar", ".7z", ".rar")


@dataclass
class SceneOptions(DataParserConfig):
    """Where a scene is, and how it is to be placed."""

    data: Path = Path()
    """A folder with sparse/0, colmap/sparse/0 or sparse (COLMAP, .bin or .txt) and images, or with
    transforms.json or transforms_train.json; or a transforms.json file itself. Where several are, COLMAP's
    model is taken."""
    colmap_path: Path | None = None
    """The folder of the COLMAP model, from `data`. None takes that with most photos."""
    images_path: Path = IMAGES
    """Folder of a COLMAP model's photos, relative to the data."""
    masks_path: Path | None = None
    """Folder of their masks, relative to the data. The mask of a.jpg is a.png, a.jpg.png or a.jpg.
    Black and transparent pixels are not trained on. A photo without a mask counts as a whole."""
    downscale_factor: int | None = None
    """Divides the photos' width and height.
    None takes the smallest of 1, 2, 4, ... that leaves no side over 1,600 px.
    Reads images_N if it fits the model; else photos are reduced in memory, by area averaging."""
    max_side: int = 0
    """Divides by the smallest whole number with which no photo is wider or higher than that, pixels. 0 leaves
    it to downscale_factor, which counts where both are given."""
    scale_factor: float = 1.0
    """Multiplies the scene's size, after auto_scale_poses."""
    orientation_method: Orientation = "up"
    """How the scene is turned. up: the mean of the cameras' up vectors becomes +z."""
    center_method: Center = "poses"
    """What becomes the origin: the mean of the cameras, the point that they look at, or nothing."""
    auto_scale_poses: bool = True
    """Scale the scene until all camera coordinates lie within -1 to 1."""


@dataclass(frozen=True)
class Prepared:
    """What all splits of a scene share. Lists run in the order of the scene's frames."""

    scene: Scene
    sources: list[PhotoSource]
    lenses: list[Lens]  # final cameras: reduced, undistorted
    factor: int  # by which the photos' width and height were to be divided
    similarity: Similarity  # from the scene's world to that of training
    points: dict[str, Tensor]
    """points3D_xyz float32 [n, 3], world of training, and points3D_rgb uint8 [n, 3]; empty without any."""
    points_in_model: np.ndarray  # the same points, float64 [n, 3], in the scene's world
    chosen: tuple[str, ...] = ()  # what was chosen where the user said nothing


def read_scene(options: SceneOptions) -> Scene:
    """What the model says: COLMAP's before transforms.json, and that before transforms_train.json."""
    data, images, masks = options.data, options.images_path, options.masks_path
    whole = data if data.suffix == ".json" else data / f"{TRANSFORMS}.json"
    models = find_models(data) if options.colmap_path is None else [data / options.colmap_path]
    if models and not (whole.exists() and models == [data]):  # whose cameras.txt may be anything
        scene = read_colmap(data, models[0], images, masks)
        if len(models) > 1:
            others = ", ".join(os.path.relpath(model, data) for model in models[1:])
            more = f"the others have no more photos ({others}): {OPTION}colmap-path takes one of them"
            scene.notes.append(f"{models[0]} is used, with {len(scene.frames)} photos; {more}.")
        if whole.exists():
            scene.notes.append(f"{models[0]} is used; give --data {whole} for the other.")
        return scene
    for path in (whole, data / f"{TRANSFORMS}_train.json"):
        if path.exists():
            if (images, masks) != (IMAGES, None):
                fix = f"leave out {OPTION}images-path and masks-path"
                raise InputError(f"{path} names photos and masks itself: {fix}.")
            return read_transforms(path) if path == whole else read_split_transforms(data)
    found = "is a file" if data.exists() else "does not exist"
    if data.is_dir():
        found = "holds no model (such as sparse/0/cameras.bin or transforms.json)"
    raise InputError(f"--data {data} {found}; {_advice(data)}.")


def _advice(data: Path) -> str:
    """What to do where `data` holds no model."""
    files = [data] if data.is_file() else list(visible_files(data))
    models = [path for path in files if path.name in _MODEL_FILES]
    for place in (*data.absolute().parents[:3], *(above for path in models for above in path.parents[:3])):
        named = any((place / name).exists() for name in _MODEL_FILES if name.endswith(".json"))
        if named or ((place / IMAGES).is_dir() and find_models(place)):
            return f"give --data {place}"
    if models:
        folder = models[0].parent
        return f"a model lies in {folder}: set {OPTION}colmap-path {folder.relative_to(data)}"
    if data.name in MIP_NERF_360:
        return f"download {data.name} from https://jonbarron.info/mipnerf360 and unpack it there"
    ends = {path.suffix.lower(): path for path in files}
    video, archive = (next((ends[e] for e in kind if e in ends), None) for kind in (_VIDEOS, _ARCHIVES))
    has_photos = not SUFFIXES.isdisjoint(ends)  # so that others are beside the point
    if video and not has_photos:
        whole = data.with_suffix("") if data.is_file() else data
        at, film = shlex.quote(str(whole)), shlex.quote(str(video))
        frames = f"`mkdir -p {at}/images; ffmpeg -i {film} -r 2 {at}/images/%04d.jpg`"
        return f"make photos of the video with {frames}, then `abcd poses {at} --order video`"
    if archive and not has_photos:
        return f"unpack {archive} and give the folder that comes of it"
    if data.is_file():
        return "give the folder that holds the photos and a COLMAP model or a transforms.json"
    made = f"with `abcd poses {data}`, which reads the photos in {data}/images"
    return f"give a folder with a COLMAP model, or make one {made}"


def prepare(options: SceneOptions, needs_photos: bool) -> Prepared:
    """Read the model, look at the header and the end of every photo, and place the scene in its frame.
    Viewing and exporting do without `needs_photos`."""
    wanted = options.downscale_factor
    if wanted is not None and (int(wanted) != wanted or wanted < 1):
        raise InputError(f"{DOWNSCALE} is {wanted}; it must be a whole number from 1.")
    if options.max_side < 0:
        raise InputError(f"{OPTION}max-side is {options.max_side}; it must be a number of pixels, or 0.")
    if not 0 < options.scale_factor < math.inf:
        raise InputError(f"{OPTION}scale-factor is {options.scale_factor}; it must be above 0 and finite.")
    problems = Problems()
    try:
        scene = as_stored(read_scene(options))
        factor = automatic_factor(scene, options.max_side) if wanted is None else int(wanted)
        with problems.collect():
            check_layout(scene)
        with problems.collect():
            files = _find_photos(scene, factor, needs_photos)
    except OSError as error:
        where = error.filename or options.data
        raise InputError(f"{where} cannot be read ({error.strerror}); check its permissions.") from None
    problems.raise_if_any()
    sources, lenses = _sources(scene, files)
    poses = np.stack([frame.camera_to_world for frame in scene.frames])
    placed = (options.orientation_method, options.center_method, options.auto_scale_poses)
    similarity = normalizing_similarity(poses, *placed, options.scale_factor)
    points, in_model = _points(scene, similarity)
    notes, lists = scene.notes, scene.split_lists
    if lists and (both := len(lists.train & lists.held_out)):
        notes.append(f"{both} view(s) are trained on and held out: scores there say nothing about new views.")
    masked = sum(source.mask_path is not None for source in sources)
    if 0 < masked < len(sources):
        notes.append(f"{masked} of {len(sources)} photos have a mask; the others count as a whole.")
    chosen = wanted is None and not options.max_side and factor > 1
    reduced = (_reduction(scene, sources, factor),) if chosen and needs_photos else ()
    return Prepared(scene, sources, lenses, factor, similarity, points, in_model, reduced)


def automatic_factor(scene: Scene, max_side: int = 0) -> int:
    """The smallest power of two that leaves no side longer than MAX_AUTO_SIDE, as nerfstudio's parsers have
    it, but by the largest photo. With `max_side` the smallest whole number that leaves none longer."""
    longest = max((max(frame.lens.size) for frame in scene.frames), default=1)
    if max_side:
        return -(-longest // max_side)
    return 2 ** max(math.ceil(math.log2(longest / MAX_AUTO_SIDE)), 0)


def _reduction(scene: Scene, sources: list[PhotoSource], factor: int) -> str:
    full = max((frame.lens.size for frame in scene.frames), key=max)
    longest = max(max(source.reduced) for source in sources)
    reduced = f"reduced {factor} times, to {longest} px at most, as splatfacto does"
    return f"Photos of up to {full[0]} x {full[1]} px are {reduced}; {DOWNSCALE} 1 keeps their size."


def check_masks(sources: list[PhotoSource]) -> None:
    """Decode every mask, and list all that cannot be read, do not fit their photo or hide all of it."""
    masked = [source for source in sources if source.mask_path is not None]
    photos, problems = Photos(masked, budget_bytes=0), Problems()

    def look(row: int) -> list[str]:
        with (found := Problems()).collect():
            photos.mask(row)
        return found

    with ThreadPoolExecutor() as pool:
        for lines in tracked(pool.map(look, range(len(masked))), "Looking at masks", len(masked)):
            problems.extend(lines)
    problems.raise_if_any()


def _find_photos(scene: Scene, factor: int, needed: bool) -> list[PhotoSource]:
    problems = Problems()
    for frame in scene.frames:
        if frame.mask_path is not None:
            with problems.collect():  # measured before it is decoded
                read_size(frame.mask_path, "mask")
    with problems.collect():
        found = locate_photos(scene, factor)
    if problems and not needed:
        scene.notes.append(f"Going on without photos: {problems[0]}")
        return assume_photos(scene, factor)
    problems.raise_if_any()
    return found


def _sources(scene: Scene, files: list[PhotoSource]) -> tuple[list[PhotoSource], list[Lens]]:
    """Photo sources and final cameras. A lens without distortion is left alone, pixel for pixel."""
    sources, lenses, problems = [], [], Problems()
    for frame, file in zip(scene.frames, files, strict=True):
        lens = frame.lens.resized(*file.reduced)
        with problems.collect(f"{frame.name}: ", name=frame.name):
            flat = undistortion(lens) if lens.distorted else None
            sources.append(replace(file, undistortion=flat, mask_path=frame.mask_path))
            lenses.append(flat.pinhole if flat else lens)
    problems.raise_if_any()
    return sources, lenses


def _points(scene: Scene, similarity: Similarity) -> tuple[dict[str, Tensor], np.ndarray]:
    """Metadata as splatfacto expects it, and the points in the scene's world."""
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = similarity.points(scene.points_xyz).astype(np.float32)
    good, model, notes = np.isfinite(xyz).all(axis=1), scene.model, scene.notes
    if not good.all():
        notes.append(f"{model}: {(~good).sum()} points with NaN, infinity or absurd numbers are left out.")
    if not good.any():
        fix = "make some with `point_triangulator` of the program colmap, or the whole model by `abcd poses`"
        notes.append(f"{model} has no points: Gaussians start at random places, which costs quality; {fix}.")
        return {}, np.empty((0, 3))
    rgb = scene.points_rgb
    if rgb is None:
        notes.append(f"{model}: the points have no colours: Gaussians start grey.")
        rgb = np.full(xyz.shape, GREY, np.uint8)
    rgb = np.ascontiguousarray(rgb[good])
    metadata = {"points3D_xyz": torch.from_numpy(xyz[good]), "points3D_rgb": torch.from_numpy(rgb)}
    return metadata, scene.points_xyz[good]
