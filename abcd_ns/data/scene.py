"""A scene as its model file describes it, before any scaling: lenses, frames, points and splits."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from abcd_ns.data import OPTION
from abcd_ns.data.input_errors import InputError
from abcd_ns.data.picture_files import by_loose_name, meant_by

MAX_SIDE = 100_000  # pixels along one side beyond which a width or height is taken for a broken file
MAX_COORDINATE = 1e12  # world units beyond which a camera's place is taken for a broken file
CORNER = 0.05
"""Share of width and height. Where all principal points are closer to the corner, they are in other units or
counted from the middle. That of a photo's tile may lie there, but not those of all tiles."""
SPLITS = ("train", "val", "test")
_NAMED = 3  # unknown photos that a message names; the others are counted


@dataclass(frozen=True)
class Lens:
    """Size and intrinsics of a camera, in pixels of that size; pixel centres at +0.5."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients: k1 k2 p1 p2 k3 k4 k5 k6 (or fewer), for a fisheye k1 k2 k3 k4."""
    fisheye: bool = False  # equidistant projection, as OpenCV's fisheye module has it

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    @property
    def distorted(self) -> bool:
        """Whether photos must be undistorted; a fisheye is even with all coefficients zero."""
        return self.fisheye or any(self.distortion)

    @property
    def matrix(self) -> np.ndarray:
        """Intrinsics, float64 [3, 3]."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def resized(self, width: int, height: int) -> "Lens":
        """The same lens on a photo resampled to width x height; each axis has its own ratio."""
        x, y = width / self.width, height / self.height
        pinhole = self.fx * x, self.fy * y, self.cx * x, self.cy * y
        return Lens(width, height, *pinhole, self.distortion, self.fisheye)


@dataclass(frozen=True)
class Frame:
    """One posed photo."""

    name: str  # path of the photo inside the photo folder; the order of frames is the order of names
    camera_to_world: np.ndarray
    """float64 [3, 4], OpenGL convention (x right, y up, z backward), world of the Scene."""
    lens: Lens
    mask_path: Path | None = None


@dataclass(frozen=True)
class SplitLists:
    """Names of frames. The two may have some in common, and some may be in neither."""

    train: frozenset[str]
    held_out: frozenset[str]
    fault: InputError | None = None  # why they are no split; raised where one is needed

    def rows(self, names: Sequence[str], split: str) -> list[int]:
        """Rows of `names` that belong to "train", or else to the views held out."""
        if self.fault is not None:
            raise self.fault
        wanted = self.train if split == "train" else self.held_out
        return [row for row, name in enumerate(names) if name in wanted]


@dataclass(frozen=True)
class Scene:
    """All that a model file says. Frames are sorted by name."""

    model: Path  # the file or folder that was read, for messages
    root: Path  # the data root; no path leads out of it
    photo_folder: Path  # holds the photos; reduced copies may lie beside it, as in images_4
    frames: list[Frame]
    points_xyz: np.ndarray  # float64 [n, 3], world of the Scene
    points_rgb: np.ndarray | None  # uint8 [n, 3]; None where the model gives no colours
    applied_transform: np.ndarray = field(default_factory=lambda: np.eye(4)[:3])
    """float64 [3, 4]: world of the Scene = applied_scale x (applied_transform @ original coordinates)."""
    applied_scale: float = 1.0
    split_lists: SplitLists | None = None  # which frames are trained on and held out, if the data say so
    notes: list[str] = field(default_factory=list)  # what the user should know but need not repair


def check_lens(lens: Lens, label: str) -> None:
    """Refuse what no camera has; lenses are told apart from broken files by wide margins."""
    side = max(lens.size)
    if not 0 < min(lens.size) <= side <= MAX_SIDE:
        raise InputError(f"{label} has the size {lens.width} x {lens.height}; make the model again.")
    if not all(map(math.isfinite, (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion))):
        raise InputError(f"{label} has NaN or infinite parameters; make the model again.")
    for name, focal in (("fx", lens.fx), ("fy", lens.fy)):
        if not side / 50 < focal < side * 1000:
            raise InputError(f"{label} has the focal length {name} = {focal:g} px; make the model again.")
    if not (-side < lens.cx < 2 * side and -side < lens.cy < 2 * side):
        raise InputError(f"{label} has a principal point outside the photo, ({lens.cx:g}, {lens.cy:g}).")


def distorted_lens(plain: Lens, coefficients: Sequence[float], label: str) -> Lens:
    """The lens with nerfstudio's coefficients k1 k2 k3 k4 p1 p2, checked."""
    k1, k2, k3, k4, p1, p2 = coefficients
    if k4 != 0 and not plain.fisheye:  # of the 8th power of r
        raise InputError(f"{label} has k4 = {k4:g}, which OpenCV cannot undistort; undistort it first.")
    if plain.fisheye and (p1 or p2):
        raise InputError(f"{label} has p1 = {p1:g}, p2 = {p2:g}, which no fisheye has; undistort it first.")
    lens = replace(plain, distortion=(k1, k2, k3, k4) if plain.fisheye else (k1, k2, p1, p2, k3))
    check_lens(lens, label)
    return lens


def rigid(matrix: np.ndarray, label: str) -> np.ndarray:
    """`matrix` [3 or 4, 4] as float64 [3, 4] with its rotation made exact (the nearest one)."""
    if matrix.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{label} must be a 4 x 4 or 3 x 4 matrix, not {matrix.shape}.")
    if not np.isfinite(matrix).all():
        raise InputError(f"{label} holds NaN or infinity; remove the frame or repair its pose.")
    if (far := np.abs(matrix[:3, 3]).max()) > MAX_COORDINATE:
        raise InputError(f"{label} is {far:.1g} units from the origin; remove the frame or repair its pose.")
    matrix = matrix.astype(np.float64)
    u, stretch, vt = np.linalg.svd(matrix[:3, :3])
    if not np.abs(stretch - 1).max() <= 1e-2 or np.linalg.det(matrix[:3, :3]) < 0:
        raise InputError(f"{label} is no rotation (it scales or mirrors); repair its pose or remove it.")
    return np.concatenate([u @ vt, matrix[:3, 3:]], axis=1)


def check_layout(scene: Scene) -> None:
    """Refuse scenes that no frame of reference can be made for, and names that are there twice."""
    if len(scene.frames) < 2:
        raise InputError(f"{scene.model} has {len(scene.frames)} camera(s), and 2 are needed: add photos.")
    counts = Counter(frame.name for frame in scene.frames)
    twice = [name for name, count in counts.items() if count > 1]
    if twice:
        raise InputError(*(f"{scene.model} names the photo {n} twice; keep one pose of it." for n in twice))
    shares = [(frame.lens.cx / frame.lens.width, frame.lens.cy / frame.lens.height) for frame in scene.frames]
    if np.abs(shares).max() < CORNER:
        where = f"({scene.frames[0].lens.cx:g}, {scene.frames[0].lens.cy:g}), the upper left corner"
        fix = "give pixels from that corner, usually half the width and height"
        raise InputError(f"{scene.model} has all principal points near {where}; {fix}.")
    centers = np.stack([frame.camera_to_world[:, 3] for frame in scene.frames])
    if np.abs(centers - centers[0]).max() <= 1e-12 * np.abs(centers).max():
        raise InputError(f"{scene.model} has all cameras at one place; add photos from other places.")


def split_lists(
    found: Mapping[str, Sequence[str]], known: Mapping[str, str], label: Callable[[str], str]
) -> SplitLists | None:
    """The lists that there are as one split, or why they are none; None without any. What is held out is val
    and test together. If only one side is listed, the other is all the rest.

    `found` is what each list names, `known` the name of each frame by what lists call it, or nearly, as files
    are found by FileFinder; `label` gives what messages call the list of a split.
    """
    if not found:
        return None
    faults, everything, fix = [], frozenset(known.values()), f"set {OPTION}eval-mode interval"
    loose = by_loose_name(known.items())
    called = {name: known.get(name) or meant_by(name, loose) for names in found.values() for name in names}
    for split, names in found.items():
        unknown = [name for name in dict.fromkeys(names) if called[name] is None]
        if unknown:
            few = ", ".join(unknown[:_NAMED]) + (", ..." if len(unknown) > _NAMED else "")
            photos = "a photo" if len(unknown) == 1 else f"{len(unknown)} photos"
            faults.append(f"{label(split)} names {photos} without a pose ({few}); correct it, or {fix}.")
    if not faults:
        listed = {split: frozenset(called[name] for name in names) for split, names in found.items()}
        held_out = listed.get("val", frozenset()) | listed.get("test", frozenset())
        train = listed.get("train", everything - held_out)
        if listed.keys() == {"train"}:
            held_out = everything - train
        if train and held_out:
            return SplitLists(train, held_out)
        side = "hold out" if train else "train on"
        faults = [f"{label(next(iter(found)))} leaves nothing to {side}; {fix}."]
    return SplitLists(frozenset(), frozenset(), InputError(*faults))


def read_list_files(data: Path, known: Mapping[str, str]) -> SplitLists | None:
    """The split of train_list.txt, val_list.txt and test_list.txt in `data`: a photo's name in each line.
    `known` is the name of each frame, by what the model calls it."""
    found = {}
    for split in SPLITS:
        if (path := data / f"{split}_list.txt").is_file():
            lines = path.read_text(encoding="utf-8-sig", errors="surrogateescape").splitlines()
            found[split] = [line.strip() for line in lines if line.strip()]
    known = {name: name for name in known.values()} | dict(known)
    return split_lists(found, known, lambda split: f"{data / split}_list.txt")
