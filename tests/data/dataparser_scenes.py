"""Small scenes as users have them, written through pycolmap, and how a parser is asked about them."""

import io
import json
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from abcd_ns.data.colmap_model import Z_UP, read_colmap
from abcd_ns.data.input_errors import InputError
from abcd_ns.nerfstudio.dataparser import AbcdDataParser, AbcdDataParserConfig

SIZES = ((61, 41), (47, 33))
"""Of the two cameras; odd, so that halving rounds down."""
NAMES = [f"{'left' if i % 2 else 'right'}/{i // 2:04d}.png" for i in range(10)]
XYZ = np.arange(12.0).reshape(4, 3)
"""Of the points of `write_cloud`, if nothing else is said."""


def write_model(
    folder: Path,
    *,
    text: bool = False,
    offset: float = 0.0,
    points: int = 20,
    params: Callable[[int, int], tuple[str, list[float]]] | None = None,
    names: list[str] = NAMES,
) -> pycolmap.Reconstruction:
    """Cameras on an arc that look at points around `offset`, through pycolmap; two camera sizes in turn."""
    rng = np.random.default_rng(0)
    params = params or (lambda w, h: ("PINHOLE", [w * 0.9, w * 0.95, w / 2 + 1, h / 2 - 2]))
    model = pycolmap.Reconstruction()
    for number, (width, height) in enumerate(SIZES, start=1):
        kind, values = params(width, height)
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model=kind, width=width, height=height, params=values)
        )
    for i, name in enumerate(names):
        angle = 0.9 * i / len(names) - 0.4
        rotation = pycolmap.Rotation3d(np.array([0.02 * i, angle, 0.01]))
        center = np.array([4 * np.sin(angle), 0.1 * i, -4 * np.cos(angle)]) + offset
        pose = pycolmap.Rigid3d(rotation.inverse(), -(rotation.inverse() * center))
        image = pycolmap.Image(name=name, camera_id=1 + i % 2, image_id=len(names) - i)
        model.add_image_with_trivial_frame(image, pose)
    for xyz in rng.uniform(-1, 1, (points, 3)):
        model.add_point3D(xyz + offset, pycolmap.Track(), rng.integers(0, 256, 3).astype(np.uint8))
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(folder))
    return model


def write_photos(folder: Path, names: list[str] = NAMES, divide: float = 1, rounded: Callable = int) -> None:
    """Noise photos of the cameras' sizes, divided and rounded."""
    rng = np.random.default_rng(1)
    for i, name in enumerate(names):
        width, height = (rounded(side / divide) for side in SIZES[i % 2])
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (height, width, 3), dtype=np.uint8)).save(folder / name)


def write_capture(
    folder: Path, names: list[str] = NAMES, photos: list[str] | None = None, divide: float = 1, **options
) -> pycolmap.Reconstruction:
    """A model and its photos, which may be called otherwise, where they are looked for."""
    write_photos(folder / "images", names if photos is None else photos, divide)
    return write_model(folder / "sparse/0", names=names, **options)


def parser(data: Path, **options) -> AbcdDataParser:
    return AbcdDataParserConfig(data=data, **options).setup()


def project(outputs, index: int) -> np.ndarray:
    """Pixels float64 [n, 2] of the outputs' own points in one of its cameras, written out."""
    camera = outputs.cameras[index]
    pose = camera.camera_to_worlds.double().numpy() * [1, -1, -1, 1]
    local = (outputs.metadata["points3D_xyz"].double().numpy() - pose[:, 3]) @ pose[:, :3]
    fx, fy, cx, cy = (getattr(camera, name).item() for name in ("fx", "fy", "cx", "cy"))
    return local[:, :2] / local[:, 2:] * [fx, fy] + [cx, cy]


def project_pycolmap(model: pycolmap.Reconstruction, name: str) -> np.ndarray:
    image = model.find_image_with_name(name)
    return np.stack([image.project_point(point.xyz) for _, point in sorted(model.points3D.items())])


def refusal(data: Path, **options) -> str:
    with pytest.raises(InputError) as caught:
        parser(data, **options).get_dataparser_outputs()
    return str(caught.value)


def write_transforms(scene: Path, change: Callable[[dict], None] = lambda _: None, **extra) -> dict:
    """The COLMAP scene of the fixture as nerfstudio would write it, in place of the model. `change` is done
    to each frame, and `extra` stands beside them."""
    model = read_colmap(scene, scene / "sparse/0")
    shutil.rmtree(scene / "sparse")
    frames = []
    for frame in reversed(model.frames):
        lens, pose = frame.lens, np.concatenate([frame.camera_to_world, [[0, 0, 0, 1]]]).tolist()
        intrinsics = {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
        size = {"w": lens.width, "h": lens.height}
        frames.append({"file_path": f"images/{frame.name}", "transform_matrix": pose, **intrinsics, **size})
        change(frames[-1])
    write_cloud(scene / "points.ply", "uint8", model.points_rgb, xyz=model.points_xyz)
    meta = {"ply_file_path": "points.ply", "applied_transform": Z_UP.tolist(), "frames": frames, **extra}
    save_transforms(scene, meta)
    return meta


def save_transforms(scene: Path, meta: dict) -> None:
    (scene / "transforms.json").write_text(json.dumps(meta))


def write_cloud(
    path: Path,
    kind: str,
    rgb: np.ndarray,
    names: tuple[str, ...] = ("red", "green", "blue"),
    xyz: np.ndarray = XYZ,
) -> Path:
    """An ascii .ply of points with colours of a type."""
    types = [*(f"property double {axis}" for axis in "xyz"), *(f"property {kind} {name}" for name in names)]
    rows = [" ".join(map(str, row)) for row in np.c_[xyz.astype(object), rgb.astype(object)]]
    head = ["ply", "format ascii 1.0", f"element vertex {len(xyz)}", *types, "end_header"]
    path.write_text("\n".join([*head, *rows, ""]))
    return path


def add_mask(scene: Path, frame: dict, called: str = "masks/{path}") -> Path:
    """A white mask for a frame of transforms.json; `called` is its path by the parts of the photo's."""
    photo = Path(frame["file_path"])
    frame["mask_path"] = called.format(path=photo, folder=photo.parent, stem=photo.stem, name=photo.name)
    path = scene / frame["mask_path"]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", (frame["w"], frame["h"]), 255).save(path)
    return path


def png_that_claims(size: tuple[int, int], mode: str = "RGB", depth: int = 8) -> bytes:
    """A small PNG whose header names a size and a number of bits a channel."""
    file = io.BytesIO()
    Image.new(mode, (4, 4)).save(file, format="PNG")
    data = bytearray(file.getvalue())
    struct.pack_into(">IIB", data, 16, *size, depth)
    struct.pack_into(">I", data, 29, zlib.crc32(bytes(data[12:29])))  # the checksum covers them
    return bytes(data)
