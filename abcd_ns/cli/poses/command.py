"""`abcd poses`: from a folder of photos to a data set that can be trained on."""

import os
import shlex
import shutil
from collections import Counter
from pathlib import Path
from typing import Annotated

import pycolmap
import tyro
from rich.console import Console

from abcd_ns.cli.poses.mapping import Order, Task, find_poses
from abcd_ns.cli.terminal import few, print_plain
from abcd_ns.data.input_errors import Problems
from abcd_ns.data.picture_files import SUFFIXES, UNREAD, check_complete, read_size
from abcd_ns.errors import UserError

WORK = "poses.part"
"""The folder in which models are made; a command that is killed leaves it, the next one removes it."""
FEWEST = 3
"""Photos."""
MANY = 400
"""With more photos, comparing each with each takes hours."""


def poses(
    data: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    order: Order = "any",
    lens: str = "OPENCV",
    several_lenses: bool = False,
    seed: int = 0,
) -> int:
    """Find the camera poses of photos, and points of the scene, by pycolmap.

    abcd poses garden

    Reads DATA/images and writes a COLMAP model to DATA/sparse/0. Then `ns-train abcd --data DATA` trains.
    Photos should be sharp, overlap by two thirds and show nothing that moves. On a CPU 50 photos take
    minutes. Twice as many take four times as long.

    Args:
        data: Folder of the scene.
        order: "any" compares each photo with each. "video" compares it with those that follow by name.
        lens: COLMAP's camera model. OPENCV suits phones and cameras.
            OPENCV_FISHEYE suits fisheyes, PINHOLE photos without distortion.
        several_lenses: The photos are of several lenses, or zoomed. Assumed where their sizes differ.
        seed: Seed of pycolmap's random choices.

    Returns:
        0; 1 if fewer than half of the photos have a pose.
    """
    photos = data / "images"
    names, sizes = _look(photos)
    if (data / "sparse").exists():
        raise UserError(f"{data / 'sparse'} exists already; move it away to find poses anew.")
    lenses = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
    if lens not in lenses:
        raise UserError(f"--lens {lens} is no camera model of COLMAP's: {', '.join(lenses)}.")
    console, notes = Console(), _unread(photos)
    if not several_lenses and len(sizes) > 1:
        several_lenses = True
        notes.append(f"Photos of {len(sizes)} sizes: assuming several lenses.")
    if order == "any" and len(names) > MANY:
        notes.append(f"Comparing {len(names)} photos with each other takes hours. For video: --order video.")
    for line in notes:
        print_plain(line, console)
    task = Task(photos, names, data / WORK, lens, not several_lenses, order, seed)
    _put_model(data / "sparse", task, console)
    return _report(data, names, console)


def _put_model(sparse: Path, task: Task, console: Console) -> None:
    """Find poses; the model becomes `sparse`/0."""
    shutil.rmtree(task.work, ignore_errors=True)
    task.work.mkdir()
    try:
        found = find_poses(task, console)
        if found is None:
            why = "They need to overlap, and to be taken from different places."
            raise UserError(f"No two photos in {task.photos} match. {why}")
        sparse.mkdir()
        os.replace(found, sparse / "0")
    finally:
        shutil.rmtree(task.work, ignore_errors=True)


def _look(folder: Path) -> tuple[tuple[str, ...], set[tuple[int, int]]]:
    """The photos' names in their folder, sorted, and what sizes they have."""
    if not folder.is_dir():
        raise UserError(f"{folder} does not exist; put the photos there.")
    found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    if len(found) < FEWEST:
        words = f"{folder} has {len(found)} photos; at least {FEWEST} are needed, better 30."
        raise UserError(" ".join([words, *_unread(folder)]))
    problems, sizes = Problems(), set()
    for path in found:
        with problems.collect():
            sizes.add(read_size(path))
            check_complete(path)
    problems.raise_if_any()
    return tuple(str(path.relative_to(folder)) for path in found), sizes


def _unread(folder: Path) -> list[str]:
    """A sentence about pictures in the folder that are passed over, if there are any."""
    kinds = Counter(p.suffix for p in folder.rglob("*") if p.suffix.lower() in UNREAD and p.is_file())
    if not kinds:
        return []
    (most, _), *_ = kinds.most_common()
    counted = ", ".join(f"{count:,} {kind}" for kind, count in sorted(kinds.items()))
    return [f"Not read: {counted}; make JPEGs of them, by `mogrify -format jpg *{most}` for instance."]


def _report(data: Path, names: tuple[str, ...], console: Console) -> int:
    model = pycolmap.Reconstruction(data / "sparse" / "0")
    posed = {model.image(row).name for row in model.reg_image_ids()}
    left_out, fewer_than_half = sorted(set(names) - posed), 2 * len(posed) < len(names)
    lines = [
        f"{len(posed)} of {len(names)} photos have a pose, {model.num_points3D():,} points, mean error "
        f"{model.compute_mean_reprojection_error():.2f} px: {data / 'sparse' / '0'}"
    ]
    if left_out:
        lines.append(f"Without a pose, and not used: {few(left_out)}. They overlap too little with others.")
    if fewer_than_half:
        lines.append("That is fewer than half. Take photos between those that do not match, or try --lens.")
    lines.append(f"Next: ns-train abcd --data {shlex.quote(str(data))}")
    print_plain("\n".join(lines), console)
    return int(fewer_than_half)
