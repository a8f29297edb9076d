"""Reads COLMAP models, binary and text, and checks every length before it trusts a count.

The format is https://colmap.github.io/format.html. Files are walked here rather than by pycolmap,
which loads a cut cameras.bin silently and hangs on an empty points3D.bin.
"""

import mmap
import os
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from abcd_ns.data.input_errors import InputError, Problems
from abcd_ns.data.picture_files import FileFinder, check_regular, check_two_files
from abcd_ns.data.ply import read_points
from abcd_ns.data.scene import Frame, Lens, Scene, check_lens, read_list_files, rigid

MODEL_FOLDERS = ("sparse/*", "colmap/sparse/*", "sparse", "colmap/sparse", "colmap")
"""Where models may lie under the data folder, if not in it."""
IMAGES = Path("images")  # where its photos lie, if nothing else is said

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""COLMAP's guess of down (+y) becomes nerfstudio's down (-z). A permutation: it rounds nothing."""

CAMERA_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
}
"""COLMAP's model id: name and number of parameters, for the models that OpenCV can undistort."""

_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
_PART = 1 << 16  # points gathered at a time
_MAX_NAME = 1 << 16  # bytes within which a name must end


def find_models(data: Path) -> list[Path]:
    """The folders of `data` that hold a COLMAP model; that with most photos comes first."""
    places = [place for each in MODEL_FOLDERS for place in sorted(data.glob(each))]
    found = [p for p in places if _part(p, "cameras") or _part(p, "images")]
    found += [data] if _part(data, "cameras") and _part(data, "images") else []
    return sorted(found, key=_count_photos, reverse=True) if len(found) > 1 else found


def read_colmap(data: Path, model: Path, images: Path = IMAGES, masks: Path | None = None) -> Scene:
    """The scene of a COLMAP model, in a z-up world: `applied_transform` is the change of axes from COLMAP's.

    `model` is the folder with cameras and images, as .bin or else .txt, and points3D as either or .ply.
    `images` and `masks` are folders from the root `data`. Where there is no IMAGES, photos may lie in `data`
    itself. The mask of a.jpg is a.png, a.jpg.png or a.jpg.
    """
    problems, found = Problems(), []
    cameras, listed = (_part(model, name) or model / f"{name}.bin" for name in ("cameras", "images"))
    for path in (cameras, listed, _part(model, "points3D")):
        with problems.collect():
            found.append(_READERS[path.name](path) if path else (np.empty((0, 3)), None))
    problems.raise_if_any()
    lenses, posed, (xyz, rgb) = found
    for number, lens in lenses.items():
        with problems.collect(name=f" {number} "):
            check_lens(lens, f"{cameras}: camera {number}")
    photos = _photo_folder(data, images, [name for name, *_ in posed])
    files, frames, called = FileFinder(photos, listed), [], {}
    hidden = None if masks is None else FileFinder(data / masks, data / masks)
    for name, quat, translation, camera in posed:
        label, lacks = f"{listed}: {name}", f"which {cameras.name} does not have"
        with problems.collect(name=name):
            if camera not in lenses:
                raise InputError(f"{label} uses camera {camera}, {lacks}; make the model again.")
            photo = files.find(name)
            called[name] = photo.relative_to(os.path.abspath(photos)).as_posix()
            pose, mask = _camera_to_world(quat, translation, label), None
            if hidden and not (mask := _mask(hidden, called[name], photo)) and _mask(hidden, called[name]):
                check_two_files(photo, name, photo.name)
            frames.append(Frame(called[name], pose, lenses[camera], mask))
    if hidden and frames and not any(frame.mask_path for frame in frames):
        lacks = "has no mask" if hidden.folder.is_dir() else "does not exist, nor a mask"
        problems.append(f"{hidden.folder} {lacks} such as {frames[0].name}.png; put masks there.")
    problems.raise_if_any()
    frames.sort(key=lambda frame: frame.name)
    xyz, lists = xyz @ Z_UP[:, :3].T, read_list_files(data, called)
    return Scene(model, data, photos, frames, xyz, rgb, Z_UP, split_lists=lists, notes=files.notes)


def _part(model: Path, name: str) -> Path | None:
    """A file of a model, .bin before .txt. One of no bytes holds no points, as COLMAP's manual has it."""
    paths = (model / file for file in _READERS if file.startswith(name) and (model / file).exists())
    return next((p for p in paths if name != "points3D" or p.stat().st_size or not p.is_file()), None)


def _count_photos(model: Path) -> int:
    """How many a model says that it has; a line and one of 2D points for each, in text."""
    if (path := _part(model, "images")) is None:
        return 0
    if path.suffix == ".txt":
        return (sum(1 for _ in _lines(path, blank=True)) + 1) // 2
    try:
        return _Cursor(path).take("Q")[0]
    except InputError:  # another model may be sound
        return -1


def _photo_folder(data: Path, images: Path, names: list[str]) -> Path:
    """`images`, as its case may be; or `data` itself, where the first photo lies there."""
    photos = data / images
    if photos.is_dir() or images != IMAGES:
        return photos
    for path in data.iterdir():
        if path.is_dir() and path.name.lower() == IMAGES.name:
            return path
    is_flat = names and FileFinder(data, data).find(names[0], moved=False).is_file()
    return data if is_flat else photos


def _mask(files: FileFinder, name: str, photo: Path | None = None) -> Path | None:
    """The mask of that name, which is not `photo`."""
    paths = (files.find(each, moved=False) for each in (str(Path(name).with_suffix(".png")), f"{name}.png"))
    return next((path for path in paths if path != photo and path.exists()), None)


def _camera_to_world(quat: np.ndarray, translation: np.ndarray, label: str) -> np.ndarray:
    """Invert COLMAP's world to camera (w, x, y, z), t and turn it to OpenGL axes and a z-up world."""
    norm = np.linalg.norm(quat)
    if not (np.isfinite(translation).all() and np.isfinite(norm) and norm > 1e-6):
        bad = "has a pose with NaN, infinity or a zero quaternion"
        raise InputError(f"{label} {bad}; remove the photo from the model.")
    rotation = Rotation.from_quat(np.roll(quat, -1)).as_matrix()
    pose = np.concatenate([rotation.T * [1, -1, -1], -rotation.T @ translation[:, None]], axis=1)
    return rigid(Z_UP[:, :3] @ pose, label)


def _lens(model: str, width: int, height: int, params: tuple[float, ...]) -> Lens:
    if model not in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"):
        params = (params[0], *params)  # one focal length stands for both
    fx, fy, cx, cy, *distortion = params
    fisheye = model.endswith("FISHEYE")
    padding = [0.0] * ((4 if fisheye else 8) - len(distortion))
    return Lens(width, height, fx, fy, cx, cy, (*distortion, *padding), fisheye)


def _unsupported(path: Path, number: int, model: object) -> InputError:
    known = ", ".join(name for name, _ in CAMERA_MODELS.values())
    fix = "undistort the scene with `colmap image_undistorter`"
    return InputError(f"{path}: camera {number} has the model {model}, not one of {known}; {fix}.")


class _Cursor:
    """Reads a binary file front to back and never past its end."""

    def __init__(self, path: Path):
        self.path = path
        check_regular(path, "file")
        with path.open("rb") as file:
            self.data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.at = 0

    def take(self, layout: str) -> tuple:
        """The next values, as struct.unpack has them."""
        start = self.at
        self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.data, start)

    def check(self, sound: bool, fault: str) -> None:
        if not sound:
            raise InputError(f"{self.path} {fault}; copy or make it again.")

    def skip(self, size: int) -> None:
        """Go on by `size` bytes, which must be there."""
        end = len(self.data)
        self.check(size <= end - self.at, f"is cut: it ends at byte {end} inside an entry")
        self.at += size

    def count(self, smallest: int) -> int:
        """A number of entries of at least `smallest` bytes each, which must fit into what is left."""
        (n,) = self.take("Q")
        left = len(self.data) - self.at
        self.check(n * smallest <= left, f"claims {n} entries but only {left} bytes follow")
        return n

    def name(self) -> str:
        """Characters up to a zero byte."""
        end = self.data.find(b"\0", self.at, self.at + _MAX_NAME)
        self.check(end >= 0, "is damaged: a photo's name has no end")
        text = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return text

    def finish(self) -> None:
        """Refuse bytes after the last entry: the count was wrong."""
        more = len(self.data) - self.at
        self.check(not more, f"has {more} bytes more than its entries need")


def _cameras_bin(path: Path) -> dict[int, Lens]:
    cursor, lenses = _Cursor(path), {}
    for _ in range(cursor.count(24 + 3 * 8)):
        number, model, width, height = cursor.take("IiQQ")
        if model not in CAMERA_MODELS:
            raise _unsupported(path, number, f"number {model}")
        name, size = CAMERA_MODELS[model]
        lenses[number] = _lens(name, width, height, cursor.take(f"{size}d"))
    cursor.finish()
    return lenses


def _images_bin(path: Path) -> list[tuple[str, np.ndarray, np.ndarray, int]]:
    cursor, images = _Cursor(path), []
    for _ in range(cursor.count(4 + 7 * 8 + 4 + 1 + 8)):
        _, *pose, camera = cursor.take("I7dI")
        name = cursor.name()
        cursor.skip(cursor.count(24) * 24)
        images.append((name, np.array(pose[:4]), np.array(pose[4:]), camera))
    cursor.finish()
    return images


def _points_bin(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(xyz float64 [n, 3], rgb uint8 [n, 3]). Tracks make entries of unlike length: chase them first."""
    cursor = _Cursor(path)
    n = cursor.count(_POINT.itemsize)
    starts = np.empty(n, dtype=np.int64)
    at, end, track = cursor.at, len(cursor.data), struct.Struct("<Q")
    for i in range(n):
        starts[i] = at
        at += _POINT.itemsize
        if at <= end:
            at += 8 * track.unpack_from(cursor.data, at - 8)[0]
        if at > end:  # at once: what a damaged length makes of `at` may not fit into `starts`
            break
    cursor.skip(at - cursor.at)
    cursor.finish()
    raw = np.frombuffer(cursor.data, dtype=np.uint8)
    xyz, rgb = np.empty((n, 3)), np.empty((n, 3), dtype=np.uint8)
    for part in (slice(i, i + _PART) for i in range(0, n, _PART)):
        points = raw[starts[part, None] + np.arange(_POINT.itemsize)].view(_POINT)[:, 0]
        xyz[part], rgb[part] = points["xyz"], points["rgb"]
    return xyz, rgb


def _lines(path: Path, blank: bool = False) -> Iterator[tuple[int, str]]:
    """(number from 1, text) of all lines but comments; `blank` ones too: an image may have no 2D points."""
    check_regular(path, "file")
    with path.open(encoding="utf-8-sig", errors="surrogateescape") as file:
        for number, line in enumerate(file, start=1):
            if not line.startswith("#") and (blank or line.strip()):
                yield number, line.strip()


def _broken_line(path: Path, number: int) -> InputError:
    return InputError(f"{path}, line {number}: not what COLMAP writes there; export the model again.")


def _cameras_txt(path: Path) -> dict[int, Lens]:
    sizes, lenses = dict(CAMERA_MODELS.values()), {}
    for number, line in _lines(path):
        try:
            camera, model, width, height, *params = line.split()
            camera, width, height = int(camera), int(width), int(height)
            params = tuple(map(float, params))
        except ValueError:
            raise _broken_line(path, number) from None
        if model not in sizes:
            raise _unsupported(path, camera, model)
        if len(params) != sizes[model]:
            raise _broken_line(path, number)
        lenses[camera] = _lens(model, width, height, params)
    return lenses


def _images_txt(path: Path) -> list[tuple[str, np.ndarray, np.ndarray, int]]:
    """Each image takes two lines: the pose, and its 2D points, which may be none."""
    images, lines = [], _lines(path, blank=True)
    for number, line in lines:
        if not line:
            continue
        words = line.split(maxsplit=9)
        try:
            pose, camera, name = np.array(list(map(float, words[1:8]))), int(words[8]), words[9]
        except (ValueError, IndexError):
            raise _broken_line(path, number) from None
        images.append((name, pose[:4], pose[4:], camera))
        number, observed = next(lines, (number + 1, ""))
        # Editors drop empty lines; the next image would then be taken for this one's 2D points.
        words = observed.split()
        if words and (len(words) % 3 or not words[-1].removeprefix("-").isdigit()):
            fix = "an image takes two lines, of which the second may be empty: export the model again"
            raise InputError(f"{path}, line {number}: not the 2D points of {name}; {fix}.")
    return images


def _points_txt(path: Path) -> tuple[np.ndarray, np.ndarray]:
    xyz, rgb = [], []
    for number, line in _lines(path):
        try:
            _, x, y, z, red, green, blue, *_ = line.split(maxsplit=7)
            xyz.append((float(x), float(y), float(z)))
            rgb.append([min(max(int(color), 0), 255) for color in (red, green, blue)])
        except ValueError:
            raise _broken_line(path, number) from None
    return np.array(xyz, dtype=np.float64).reshape(-1, 3), np.array(rgb, dtype=np.uint8).reshape(-1, 3)


_READERS = {
    "cameras.bin": _cameras_bin,
    "cameras.txt": _cameras_txt,
    "images.bin": _images_bin,
    "images.txt": _images_txt,
    "points3D.bin": _points_bin,
    "points3D.txt": _points_txt,
    "points3D.ply": read_points,
}
