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

from abcd_ns.cli.poses.mapping import Model, Order, Task, find_poses
from abcd_ns.cli.terminal import few, print_plain
from abcd_ns.data.input_errors import Problems
from abcd_ns.data.picture_files import SUFFIXES, UNREAD, check_complete, read_header
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
    """Find where photos were taken, and points of the scene: what training begins with.

    abcd poses garden

    The photos are in DATA/images. Writes a COLMAP model to DATA/sparse/0, by pycolmap; then
    `ns-train abcd --data DATA` trains. Photos should overlap by two thirds, be sharp, and show nothing that
    moves. On a CPU 50 photos take minutes. Twice as many take four times as long.

    Args:
        data: Folder of the scene.
        order: "any" compares each photo with each; "video" with those that follow by name, for many photos.
        lens: COLMAP's camera model. OPENCV suits phones and cameras, OPENCV_FISHEYE fisheyes, PINHOLE photos
            without distortion.
        several_lenses: The photos are of several lenses, or zoomed; assumed where their sizes differ.
        seed: Of pycolmap's random choices.

    Returns:
        0; 1 if fewer than half of the photos have a pose.

    Raises:
        UserError: there are no photos, a model is there already, or no two photos match.
    """
    photos, names, sizes = _photos(data)
    if (data / "sparse").exists():
        raise UserError(f"{data / 'sparse'} exists already; move it away to find poses anew.")
    _check_lens(lens)
    console = Console()
    for line in _unread(photos):
        print_plain(line, console)
    one_lens = not several_lenses and len(sizes) == 1
    if not several_lenses and not one_lens:
        console.print(f"Photos of {len(sizes)} sizes: assuming several lenses.")
    if order == "any" and len(names) > MANY:
        console.print(
            f"{len(names)} photos: comparing each with each takes hours. Use --order video for a video."
        )
    task = Task(photos, names, data / WORK, lens, one_lens, order, seed)
    return _report(data, names, _model(data, task, console), console)


def _model(data: Path, task: Task, console: Console) -> Model:
    """The model that is found, put in its place."""
    try:
        shutil.rmtree(task.work, ignore_errors=True)
        task.work.mkdir()
        model = find_poses(task, console)
        if model is None:
            raise UserError(
                f"No two photos in {task.photos} match. They need to overlap, and to be taken from different "
                "places."
            )
        (data / "sparse").mkdir()
        os.replace(model.folder, data / "sparse" / "0")
    except OSError as error:
        raise UserError(f"{data} cannot be written to: {error.strerror}.") from None
    finally:
        shutil.rmtree(task.work, ignore_errors=True)
    return model


def _photos(data: Path) -> tuple[Path, tuple[str, ...], set[tuple[int, int]]]:
    """The folder of photos, their names in it, sorted, and what sizes they have."""
    folder = data / "images"
    if not folder.is_dir():
        raise UserError(f"{folder} does not exist; put the photos there.")
    found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    if len(found) < FEWEST:
        words = f"{folder} has {len(found)} photos; at least {FEWEST} are needed, better 30."
        raise UserError(" ".join([words, *_unread(folder)]))
    problems, sizes = Problems(), set()
    for path in found:
        with problems.collect():
            header = read_header(path)
            check_complete(path, header)
            sizes.add(header.size)
    problems.raise_if_any()
    return folder, tuple(str(path.relative_to(folder)) for path in found), sizes


def _unread(folder: Path) -> list[str]:
    """A sentence about pictures in the folder that are passed over, if there are any."""
    kinds = Counter(p.suffix for p in folder.rglob("*") if p.suffix.lower() in UNREAD and p.is_file())
    if not kinds:
        return []
    (most, _), *_ = kinds.most_common()
    counted = ", ".join(f"{count:,} {kind}" for kind, count in sorted(kinds.items()))
    return [f"Not read: {counted}; make JPEGs of them, by `mogrify -format jpg *{most}` for instance."]


def _check_lens(lens: str) -> None:
    if lens not in pycolmap.CameraModelId.__members__ or lens == "INVALID":
        known = ", ".join(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")
        raise UserError(f"--lens {lens} is no camera model of COLMAP's: {known}.")


def _report(data: Path, names: tuple[str, ...], model: Model, console: Console) -> int:
    left_out, fewer_than_half = sorted(set(names) - set(model.posed)), 2 * len(model.posed) < len(names)
    lines = [
        f"{len(model.posed)} of {len(names)} photos have a pose, {model.points:,} points, mean error "
        f"{model.error:.2f} px: {data / 'sparse' / '0'}"
    ]
    if left_out:
        lines.append(f"Without a pose, and not used: {few(left_out)}. They overlap too little with others.")
    if fewer_than_half:
        lines.append("That is fewer than half. Take photos between those that do not match, or try --lens.")
    lines.append(f"Next: ns-train abcd --data {shlex.quote(str(data))}")
    for line in lines:
        print_plain(line, console)
    return int(fewer_than_half)
