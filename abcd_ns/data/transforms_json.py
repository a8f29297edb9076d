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
from abcd_ns.data.picture_files import read_header
from abcd_ns.data.ply import read_points
from abcd_ns.data.scene import Frame, Lens, Scene, check_lens, inside, rigid
from abcd_ns.data.split_lists import SPLITS, SplitLists, split_lists

TRANSFORMS = "transforms"
"""What the file is called, before its ending or the name of a split."""
_PINHOLES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYES = ("OPENCV_FISHEYE",)
LARGEST = sys.float_info.max
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4")


def read_transforms(path: Path) -> Scene:
    """The scene of a transforms.json file.

    Args:
        path: the file; all paths in it are relative to its folder and stay inside.

    Returns:
        The scene in the file's world. Frames are sorted by file_path.

    Raises:
        InputError: not JSON, nothing posed, a bad pose or lens, a path out of the folder; all bad
            frames are listed.
    """
    meta = _load(path)
    root, problems = path.parent, Problems()
    model = str(meta.get("camera_model", "OPENCV"))
    if model not in _PINHOLES + _FISHEYES:
        known = ", ".join(_PINHOLES + _FISHEYES)
        raise InputError(f"{path}: camera_model {model} is not one of {known}; undistort the photos first.")
    fisheye = model in _FISHEYES or bool(meta.get("is_fisheye", False))
    frames = []
    for number, entry in enumerate(meta["frames"]):
        with problems.collect():
            frames.append(_frame(path, meta, entry, number, fisheye))
    xyz, rgb = np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8)
    with problems.collect():
        if "ply_file_path" in meta:
            xyz, rgb = read_points(inside(root, str(meta["ply_file_path"]), path))
    masks = sum(frame.mask_path is not None for frame in frames)
    if 0 < masks < len(frames):
        problems.append(f"{path}: {masks} of {len(frames)} frames have a mask_path; give one to all or none.")
    with problems.collect():
        given = _matrix(meta.get("applied_transform", np.eye(4)), path)
        transform = rigid(given, f"{path}: applied_transform")
    with problems.collect():
        scale = _number(meta, "applied_scale", str(path), default=1.0)
        if scale <= 0:
            problems.append(f"{path}: applied_scale is {scale:g}; it must be positive.")
    problems.raise_if_any()
    folder, frames = _photo_folder(root, frames)
    frames.sort(key=lambda frame: frame.name)
    lists = _split_lists(path, meta, folder.relative_to(root), [frame.name for frame in frames])
    return Scene(path, root, folder, frames, xyz, rgb, transform, scale, lists)


def read_split_transforms(folder: Path) -> Scene:
    """The scene of transforms_train.json and of transforms_test.json, or else transforms_val.json.

    Returns:
        The scene, with the points of the first. Its frames are named from `folder` on.

    Raises:
        InputError: as `read_transforms`, or the two are in different worlds.
    """
    paths = [folder / f"{TRANSFORMS}_{split}.json" for split in ("train", "test", "val")]
    scenes = [read_transforms(path) for path in [path for path in paths if path.exists()][:2]]
    train, lists = scenes[0], []
    for scene in scenes:
        same = np.array_equal(train.applied_transform, scene.applied_transform)
        if not same or train.applied_scale != scene.applied_scale:
            raise InputError(f"{scene.model} and {train.model} need the same applied_transform; make both.")
        at = os.path.relpath(scene.photo_folder, folder)
        lists.append([replace(f, name=os.path.normpath(f"{at}/{f.name}")) for f in scene.frames])
    frames = sorted((frame for frames in lists for frame in frames), key=lambda frame: frame.name)
    names = [frozenset(frame.name for frame in frames) for frames in lists]
    split = SplitLists(*names) if len(names) > 1 else None
    return replace(train, photo_folder=folder, frames=frames, split_lists=split)


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path} is not a regular file; put nerfstudio's transforms.json there.")
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON ({error}); copy or make it again.") from None
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path} has no list of frames; make it with ns-process-data.")
    return meta


def _split_lists(path: Path, meta: dict[str, Any], folder: Path, names: list[str]) -> SplitLists | None:
    """train_filenames, val_filenames and test_filenames: file_paths of frames, as nerfstudio has it."""
    found = {}
    for split in SPLITS:
        listed = meta.get(key := f"{split}_filenames", [])
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{path}: {key} must be a list of file_paths.")
        if key in meta:
            found[split] = [os.path.normpath(name) for name in listed]
    called = {str(folder / name): name for name in names}
    # As for the frames' own file_paths, the ending may be left out.
    called |= {call.removesuffix(".png"): name for call, name in called.items()}
    return split_lists(found, called, {split: f"{path}: {split}_filenames" for split in found})


def _number(values: dict[str, Any], key: str, label: str, default: float | None = None) -> float:
    """values[key] as a finite float."""
    value = values.get(key, default)
    # Compared rather than converted: JSON's whole numbers may be larger than any float.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
        raise InputError(f"{label}: {key} must be a number, not {value}.")
    return float(value)


def _matrix(value: Any, label: object) -> np.ndarray:
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{label}: a matrix must be rows of numbers, all of one length.") from None


def _frame(path: Path, meta: dict, entry: dict, number: int, fisheye: bool) -> Frame:
    root, name = path.parent, entry.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"{path}: frame {number} has no file_path; remove it or name its photo.")
    label = f"{path}: {name}"
    photo = inside(root, name, path)
    if not photo.suffix and not photo.exists():
        photo = photo.with_suffix(".png")
    pose = rigid(_matrix(entry.get("transform_matrix"), label), f"{label}: transform_matrix")
    lens = _lens({**meta, **entry}, label, photo, fisheye)
    check_lens(lens, label)
    mask = inside(root, str(entry["mask_path"]), path) if "mask_path" in entry else None
    # As nerfstudio has it, names are relative to the folder that transforms.json lies in.
    return Frame(os.path.relpath(photo, root), pose, lens, mask)


def _lens(values: dict[str, Any], label: str, photo: Path, fisheye: bool) -> Lens:
    """Intrinsics from a frame's values, which override the file's; the size may come from the photo."""
    if "w" in values and "h" in values:
        width, height = (int(_number(values, key, label)) for key in ("w", "h"))
    else:
        width, height = read_header(photo).size
    if "fl_x" not in values and "camera_angle_x" not in values:
        raise InputError(f"{label} has no focal length; give fl_x or camera_angle_x.")
    if "fl_x" not in values:
        angles = (("fl_x", "camera_angle_x", width), ("fl_y", "camera_angle_y", height))
        focals = {name: _focal(values, key, size, label) for name, key, size in angles if key in values}
        values = focals | values
    fx = _number(values, "fl_x", label)
    fy, cx, cy = (
        _number(values, key, label, default)
        for key, default in (("fl_y", fx), ("cx", width / 2), ("cy", height / 2))
    )
    return Lens(width, height, fx, fy, cx, cy, _distortion(values, label, fisheye), fisheye)


def _focal(values: dict[str, Any], key: str, size: int, label: str) -> float:
    """Pixels: size / (2 tan(angle / 2)), for the full angle of view in radians."""
    angle = _number(values, key, label)
    if not 0 < angle < math.pi:
        raise InputError(f"{label}: {key} is {angle:g} radians; it must lie between 0 and pi.")
    return size / (2 * math.tan(angle / 2))


def _distortion(values: dict[str, Any], label: str, fisheye: bool) -> tuple[float, ...]:
    """OpenCV's order. nerfstudio's k4 of a pinhole is the 8th power of r, which OpenCV does not have."""
    if "distortion_params" in values:
        row = _matrix(values["distortion_params"], label).ravel()
        if len(row) != 6:
            raise InputError(f"{label}: distortion_params must be k1 k2 k3 k4 p1 p2.")
        k1, k2, k3, k4, p1, p2 = row.tolist()
    else:
        k1, k2, p1, p2, k3, k4 = (_number(values, key, label, default=0.0) for key in _COEFFICIENTS)
    if fisheye:
        return (k1, k2, k3, k4)
    if k4 != 0:
        raise InputError(f"{label} has k4 = {k4:g}, which OpenCV cannot undistort; undistort it first.")
    return (k1, k2, p1, p2, k3)


def _photo_folder(root: Path, frames: list[Frame]) -> tuple[Path, list[Frame]]:
    """The folder that all photos share, if it is one below the root, and frames named relative to it.

    Reduced copies lie beside that folder: images and images_4.
    """
    tops = {Path(frame.name).parts[0] for frame in frames}
    if len(tops) != 1 or any(len(Path(frame.name).parts) < 2 for frame in frames):
        return root, frames
    top = tops.pop()
    return root / top, [replace(f, name=str(Path(f.name).relative_to(top))) for f in frames]
