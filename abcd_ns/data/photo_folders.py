"""Decides which folder each photo is read from, and checks all of them before training."""

import os
from dataclasses import replace
from pathlib import Path

from abcd_ns.data import DOWNSCALE, OPTION
from abcd_ns.data.colmap_model import IMAGES
from abcd_ns.data.input_errors import InputError, Problems
from abcd_ns.data.photos import PhotoSource
from abcd_ns.data.picture_files import SUFFIXES, FileFinder, is_turned, read_size, read_whole, visible_files
from abcd_ns.data.scene import Frame, Scene


def locate_photos(scene: Scene, factor: int) -> list[PhotoSource]:
    """Find and check the photos of all frames; one source for each, without undistortion and mask.

    images_N (N = `factor`) is used where every photo is there in W/N x H/N, rounded either way. Otherwise
    the full photos are reduced to floor(W/N) x floor(H/N). Where there are no full photos, the least
    reduced copies that can serve are taken.
    """
    full, copies = scene.photo_folder, _reduced_folders(scene)
    if factor in copies:
        try:
            return _check_folder(copies[factor], factor, scene.frames, factor)
        except InputError as error:
            if not full.is_dir():
                raise
            fault = error.lines[0]
            scene.notes.append(f"{copies[factor]} does not fit: {full} is reduced instead ({fault})")
    if full.is_dir():
        _note_unposed(scene)
        return _check_folder(full, 1, scene.frames, factor)
    if not copies:
        count, example = len(scene.frames), next((frame.name for frame in scene.frames), "none")
        raise InputError(f"{full} is missing: put the {count} photos there ({example}, ...){_hint(scene)}.")
    of = max((n for n in copies if factor % n == 0), default=min(copies))
    if factor % of:
        found = of * max(factor // of, 1)
        scene.notes.append(f"{full} does not exist: {copies[of]} is used, at 1/{found} and not 1/{factor}.")
    return _check_folder(copies[of], of, scene.frames, max(factor, of))


def _hint(scene: Scene) -> str:
    """Where the photos of a COLMAP model seem to lie."""
    if not (scene.frames and scene.model.is_dir()):
        return ""
    name, root = scene.frames[0].name, scene.root
    for above in root.absolute().parents[:3]:
        if (above / IMAGES / name).exists():
            return f", or give --data {above}"
    masks = {frame.mask_path for frame in scene.frames}
    for path in visible_files(root):
        folder = os.path.relpath(path.as_posix().removesuffix(name), root)
        is_mask = "mask" in folder.lower() or path.absolute() in masks
        if path.as_posix().endswith(f"/{name}") and not is_mask:
            return f", or set {OPTION}images-path {folder}"
    return ""


def as_stored(scene: Scene) -> Scene:
    """The scene with cameras of the photos' size, where all photos are the same share of what cameras say.
    The first photo is looked at; only if it has another size than its camera, so are all."""
    finder, sizes = FileFinder(scene.photo_folder, scene.model), []
    for frame in scene.frames:
        try:
            sizes.append(read_size(finder.find(frame.name)))
        except InputError:
            return scene
        if sizes == [frame.lens.size]:  # the first
            return scene
    pairs = list(zip(sizes, (frame.lens.size for frame in scene.frames), strict=True))
    (width, height), (of_width, of_height) = max(pairs, default=((1, 1), (1, 1)))
    for pair in pairs:
        if any(abs(have * of_width - want * width) >= of_width for have, want in zip(*pair, strict=True)):
            return scene
    frames = [replace(f, lens=f.lens.resized(*size)) for f, size in zip(scene.frames, sizes, strict=True)]
    sizes = f"as {width} x {height} px and {of_width} x {of_height}: cameras are scaled to them"
    larger = f"{width / of_width:.3g} times as large as their cameras"
    scene.notes.append(f"The photos in {scene.photo_folder} are {larger}, {sizes}.")
    return replace(scene, frames=frames)


def assume_photos(scene: Scene, factor: int) -> list[PhotoSource]:
    """The photos as the model describes them, without looking: for viewing and exporting."""
    named = [(frame.name, frame.lens.size) for frame in scene.frames]
    return [PhotoSource(scene.photo_folder / name, size, _reduce(name, size, factor)) for name, size in named]


def _reduced_folders(scene: Scene) -> dict[int, Path]:
    """N: folder, for the folders <photo_folder>_N beside the photo folder."""
    if scene.photo_folder == scene.root:
        return {}
    found, prefix = {}, scene.photo_folder.name
    for folder in scene.photo_folder.parent.glob("*_*"):
        name, _, number = folder.name.rpartition("_")
        if name == prefix and number.isdecimal() and int(number) > 1 and folder.is_dir():
            found[int(number)] = folder
    return found


def _check_folder(folder: Path, of: int, frames: list[Frame], factor: int) -> list[PhotoSource]:
    """The files of `frames` in a folder of photos reduced by `of`, to be reduced by `factor` in all."""
    problems, finder, files, meant = Problems(), FileFinder(folder, folder), [], {}
    for frame in frames:
        with problems.collect(name=frame.name):
            path = finder.find(frame.name)
            size = read_whole(path)
            _check_size(path, size, frame, of)
            files.append(PhotoSource(path, size, _reduce(str(path), size, factor // of)))
            if (other := meant.setdefault(path, frame.name)) != frame.name:
                raise InputError(f"{path} is all there is of {other} and of {frame.name}; copy both there.")
    problems.raise_if_any()
    return files


def _reduce(label: str, size: tuple[int, int], factor: int) -> tuple[int, int]:
    width, height = size[0] // factor, size[1] // factor
    if width == 0 or height == 0:
        raise InputError(f"{label}: {DOWNSCALE} leaves nothing of {size[0]} x {size[1]} px; lower it.")
    return width, height


def _check_size(path: Path, size: tuple[int, int], frame: Frame, of: int) -> None:
    """The stored size must be the lens's, or that divided by `of` and rounded up or down."""
    lens = frame.lens.size
    if all(abs(have - want / of) < 1 for have, want in zip(size, lens, strict=True)):
        return
    shape, wanted = f"{size[0]} x {size[1]}", f"{lens[0] / of:g} x {lens[1] / of:g}"
    if of == 1 and size == lens[::-1] and is_turned(path):
        shape = f"stored as {shape} and turned by its EXIF orientation,"
        fix = "save it turned and without EXIF, or make the model again"
    else:
        copies = "copies reduced N times go into a folder like images_N"
        fix = f"use the photos that the model was made from ({copies})"
    raise InputError(f"{path} is {shape} but its camera is {wanted}; {fix}.")


def _note_unposed(scene: Scene) -> None:
    """Note photos that the model knows nothing of: training goes on without them."""
    if scene.model.name.startswith("transforms_"):  # the others are of another split, or depths and normals
        return
    folder = scene.photo_folder
    posed = {os.path.abspath(folder / frame.name) for frame in scene.frames}
    known = posed | {os.path.abspath(frame.mask_path) for frame in scene.frames if frame.mask_path}
    found = (path for path in visible_files(folder) if path.suffix.lower() in SUFFIXES)
    extra = sorted(str(p.relative_to(folder)) for p in found if os.path.abspath(p) not in known)
    few = " Fewer than half have one: see whether the model is complete." if len(extra) > len(posed) else ""
    if extra:
        unused = f"{len(extra)} photos in {folder} have no pose and are not used ({extra[0]}, ...)"
        scene.notes.append(f"{unused}.{few}")
