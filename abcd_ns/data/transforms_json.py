"""Reads nerfstudio's transforms.json, and the kin of it that instant-ngp and Blender write."""

import json
import math
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from abcd_ns.data.input_errors import InputError, Problems
from abcd_ns.data.picture_files import FileFinder, check_two_files, read_size
from abcd_ns.data.ply import read_points
from abcd_ns.data.scene import SPLITS, Frame, Lens, Scene, SplitLists, distorted_lens, rigid, split_lists

TRANSFORMS = "transforms"  # what the file is called, before its ending or the name of a split
_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYES = ("OPENCV_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
LARGEST = sys.float_info.max
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
_SPELLINGS = (
    (("camera_model",), ("is_fisheye",)),
    (("fl_x", "fl_y"), ("camera_angle_x", "camera_angle_y"), ("x_fov", "y_fov")),
    (("distortion_params",), _COEFFICIENTS),
)
"""Keys that say the same, those that win first. A frame's spelling hides the other ones of the file."""
_UNREAD = (
    *("k5", "k6", "p3", "p4", "s1", "s2", "s3", "s4", "b1", "b2", "skew", "omega", "xi", "rolling_shutter"),
    *("latlong", "equirectangular", "ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4"),
)
"""Keys of a camera that other programs know. Where they are not zero the photos would be read wrongly."""


def read_transforms(path: Path) -> Scene:
    """The scene of a transforms.json, in its world. Paths in it are relative to its folder, and inside."""
    meta = _load(path)
    root, problems, frames = path.parent, Problems(), []
    files = FileFinder(root, path)
    for number, entry in enumerate(meta["frames"]):
        with problems.collect(name=str(entry.get("file_path"))):
            frames.append(_frame(path, files, meta, entry, number))
    xyz, rgb = np.empty((0, 3)), None
    with problems.collect():
        if meta.get("ply_file_path"):
            xyz, rgb = read_points(files.find(str(meta["ply_file_path"])))
    with problems.collect():
        given = _matrix(meta.get("applied_transform", np.eye(4)), path)
        transform = rigid(given, f"{path}: applied_transform")
    with problems.collect():
        scale = _number(meta, "applied_scale", path, default=1.0)
        if scale <= 0:
            raise InputError(f"{path}: applied_scale is {scale:g}; it must be positive.")
    problems.raise_if_any()
    called = {os.path.normpath(e["file_path"]): f.name for e, f in zip(meta["frames"], frames, strict=True)}
    folder, frames = _photo_folder(root, frames)
    lists = _split_lists(path, meta, called, os.path.relpath(folder, root))
    frames.sort(key=lambda frame: frame.name)
    return Scene(path, root, folder, frames, xyz, rgb, transform, scale, lists, files.notes)


def read_split_transforms(folder: Path) -> Scene:
    """The scene of transforms_train.json and of transforms_test.json, or else transforms_val.json, which must
    be in one world, with the points of the first. Its frames are named from `folder` on."""
    paths = [folder / f"{TRANSFORMS}_{split}.json" for split in ("train", "test", "val")]
    train, *others = [path for path in paths if path.exists()][:2]
    train, frames, names = read_transforms(train), [], []
    for scene in (train, *map(_held_out, others)):
        same = np.array_equal(train.applied_transform, scene.applied_transform)
        if not same or train.applied_scale != scene.applied_scale:
            raise InputError(f"{scene.model} and {train.model} need the same applied_transform; make both.")
        at = os.path.relpath(scene.photo_folder, folder)
        found = [replace(f, name=os.path.normpath(f"{at}/{f.name}")) for f in scene.frames]
        names.append(frozenset(frame.name for frame in found))
        # A view may be trained on and held out.
        there = {frame.name: frame.camera_to_world for frame in frames}
        frames += [f for f in found if not np.array_equal(there.get(f.name), f.camera_to_world)]
    frames.sort(key=lambda frame: frame.name)
    split = SplitLists(*names) if len(names) > 1 else None
    return replace(train, photo_folder=folder, frames=frames, split_lists=split)


def _held_out(path: Path) -> Scene:
    try:
        return read_transforms(path)
    except InputError as error:
        raise InputError(*error.lines, f"To hold out every 8th view instead, move {path} away.") from None


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path} is not a regular file; put nerfstudio's transforms.json there.")
    try:
        meta = json.loads(path.read_bytes())  # in any of Unicode's encodings
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({error}); copy or make it again.") from None
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path} has no list of frames; make it with ns-process-data.")
    return meta


def _split_lists(path: Path, meta: dict[str, Any], called: dict[str, str], folder: str) -> SplitLists | None:
    """train_filenames, val_filenames and test_filenames: file_paths of frames, as nerfstudio has it. `called`
    has the photo of each file_path, from the data root on; frames are named from `folder` on."""
    found = {}
    for split in SPLITS:
        listed = meta.get(key := f"{split}_filenames", [])
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{path}: {key} must be a list of file_paths.")
        if key in meta:
            found[split] = [os.path.normpath(name) for name in listed]
    called = called | {photo: photo for photo in called.values()}
    known = {call: os.path.relpath(photo, folder) for call, photo in called.items()}
    return split_lists(found, known, lambda split: f"{path}: {split}_filenames")


def _number(values: dict[str, Any], key: str, label: object, default: float | None = None) -> float:
    value = values.get(key, default)
    # Compared rather than converted: JSON's whole numbers may be larger than any float.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise InputError(f"{label}: {key} must be a number, not {json.dumps(value)}.")
    return float(value)


def _matrix(value: Any, label: object) -> np.ndarray:
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{label}: a matrix must be rows of numbers, all of one length.") from None


def _frame(path: Path, files: FileFinder, meta: dict, entry: dict, number: int) -> Frame:
    name = entry.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"{path}: frame {number} has no file_path; remove it or name its photo.")
    label = f"{path}: {name}"
    if entry.get("transform_matrix") is None:
        raise InputError(f"{label} has no transform_matrix; add its pose, or remove the frame.")
    if not Path(name).suffix and not (path.parent / name).exists():
        name += ".png"
    photo = files.find(name)
    pose = rigid(_matrix(entry["transform_matrix"], label), f"{label}: transform_matrix")
    lens = _lens(_camera_values(meta, entry), label, photo)
    mask = None
    if entry.get("mask_path") and (mask := files.find(str(entry["mask_path"]))) == photo:
        check_two_files(photo, name, str(entry["mask_path"]))
    # As nerfstudio has it, names are relative to the folder that transforms.json lies in.
    return Frame(os.path.relpath(photo, path.parent), pose, lens, mask)


def _camera_values(meta: dict[str, Any], entry: dict[str, Any]) -> dict[str, Any]:
    """What a frame says of its camera, and what the file says where the frame does not."""
    hidden = set()
    for spellings in _SPELLINGS:
        if any(key in entry for keys in spellings for key in keys):
            hidden.update(*(keys for keys in spellings if entry.keys().isdisjoint(keys)))
    return {key: value for key, value in meta.items() if key not in hidden} | entry


def _lens(values: dict[str, Any], label: str, photo: Path) -> Lens:
    """Intrinsics from a frame's values; the size may come from the photo."""
    model = str(values.get("camera_model", "OPENCV")).upper()
    if model not in _PINHOLES + _FISHEYES:
        known = ", ".join(_PINHOLES + _FISHEYES)
        raise InputError(f"{label}: camera_model {model} is not one of {known}; undistort the photos first.")
    unread = next((key for key in _UNREAD if np.any(_matrix(values.get(key, 0), label))), None)
    if unread:
        fix = "undistort the photos, or remove it to train as if it were 0"
        raise InputError(f"{label} has {unread} = {values[unread]}, which is not read; {fix}.")
    if (flag := values.get("is_fisheye")) not in (None, False, True):
        raise InputError(f"{label}: is_fisheye must be true or false, not {json.dumps(flag)}.")
    fisheye = model in _FISHEYES or bool(flag)
    if "w" in values and "h" in values:
        width, height = (int(_number(values, key, label)) for key in ("w", "h"))
    else:
        width, height = read_size(photo)
    focals = [_focal(values, "x", width, label), _focal(values, "y", height, label)]
    given = [focal for focal in focals if focal is not None]
    if not given:
        raise InputError(f"{label} has no focal length; give fl_x or camera_angle_x.")
    center = _number(values, "cx", label, width / 2), _number(values, "cy", label, height / 2)
    plain = Lens(width, height, given[0], given[-1], *center, fisheye=fisheye)
    return distorted_lens(plain, _coefficients(values, label), label)


def _focal(values: dict[str, Any], axis: str, size: int, label: str) -> float | None:
    """Pixels, given or by the full angle of view: size / (2 tan(angle / 2)); None if neither is there."""
    if f"fl_{axis}" in values:
        return _number(values, f"fl_{axis}", label)
    for key, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.pi / 180)):
        if key in values:
            angle = _number(values, key, label) * unit
            if not 0 < angle < math.pi:
                raise InputError(f"{label}: {key} is {angle:g} radians; it must lie between 0 and pi.")
            return size / (2 * math.tan(angle / 2))
    return None


def _coefficients(values: dict[str, Any], label: str) -> list[float]:
    if "distortion_params" not in values:
        return [_number(values, key, label, default=0.0) for key in _COEFFICIENTS]
    row = _matrix(values["distortion_params"], label).ravel()
    if len(row) != len(_COEFFICIENTS):
        raise InputError(f"{label}: distortion_params must be {' '.join(_COEFFICIENTS)}.")
    return row.tolist()


def _photo_folder(root: Path, frames: list[Frame]) -> tuple[Path, list[Frame]]:
    """The one folder below the root that all photos share, if any, and frames named relative to it."""
    tops = {frame.name.partition(os.sep)[0] for frame in frames}
    if len(tops) > 1 or any(os.sep not in frame.name for frame in frames):
        return root, frames
    top = tops.pop()
    return root / top, [replace(f, name=os.path.relpath(f.name, top)) for f in frames]
