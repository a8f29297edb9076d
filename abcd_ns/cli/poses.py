"""`abcd poses`: from a folder of photos to a data set that can be trained on.

pycolmap runs in a process of its own, as it stops late at Ctrl-C.
"""

import multiprocessing
import os
import shlex
import shutil
import sqlite3
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Annotated, Literal

import pycolmap
import tyro
from rich.console import Console
from rich.progress import Progress

from abcd_ns.data.colmap_model import CAMERA_MODELS
from abcd_ns.data.input_errors import InputError, Problems
from abcd_ns.data.picture_files import SUFFIXES, UNPOSED, UNREAD, read_whole, visible_files
from abcd_ns.errors import UserError, first_line
from abcd_ns.terminal import few, print_plain

WORK = "poses.part"
"""The folder in which models are made; a command that is killed leaves it, the next one removes it."""
FEWEST, MANY = 3, 400  # photos: fewer are refused; with more, comparing each with each takes hours
ENOUGH = 0.9  # once this share of the photos has a pose, no other focal length is tried
FOCAL_FACTORS = (1.2, 0.72, 0.5)
"""Initial focal lengths, by the photo's longer side, where EXIF has none: COLMAP's own guess, a phone's main
camera, a wide one. Bundle adjustment finds the true one from a start that is not too far off."""
OVERLAP = 12  # photos of a video are matched with that many that follow, and with some farther on

Order = Literal["any", "video"]


@dataclass(frozen=True)
class Task:
    """What is to be posed."""

    photos: Path
    names: tuple[str, ...]
    work: Path  # a folder for the database and models
    lens: str
    one_lens: bool  # whether all photos were taken with one lens at one focal length
    order: Order
    seed: int = 0

    @property
    def database(self) -> Path:
        return self.work / "database.db"


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
    lenses = [name for name, _ in CAMERA_MODELS.values()]
    if lens not in lenses:
        raise UserError(f"--lens {lens} is none of the camera models that are read: {', '.join(lenses)}.")
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
        if (found := find_poses(task, console)) is None:
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
    found = sorted(path for path in visible_files(folder) if path.suffix.lower() in SUFFIXES - UNPOSED)
    if len(found) < FEWEST:
        words = f"{folder} has {len(found)} photos; at least {FEWEST} are needed, better 30."
        raise UserError(" ".join([words, *_unread(folder)]))
    problems, sizes = Problems(), set()
    for path in found:
        with problems.collect():
            _check_name(path)
            sizes.add(read_whole(path))
    problems.raise_if_any()
    return tuple(str(path.relative_to(folder)) for path in found), sizes


def _check_name(path: Path) -> None:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(f"{path.parent}: the photo name {path.name!r} is not UTF-8; rename it.") from None


def _unread(folder: Path) -> list[str]:
    """A sentence about pictures in the folder that are passed over, if there are any."""
    kinds = Counter(path.suffix for path in visible_files(folder) if path.suffix.lower() in UNREAD | UNPOSED)
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


def find_poses(task: Task, console: Console) -> Path | None:
    """Features, matches and poses, with a progress bar each; the model's folder, None where no photos match.
    A UserError, in pycolmap's own words, if that raised or its process died."""
    count = len(task.names)
    pairs = count * (count - 1) // 2 if task.order == "any" else count * OVERLAP
    context = multiprocessing.get_context("spawn")
    posed = context.Value("i", 0)
    pool = ProcessPoolExecutor(1, mp_context=context, initializer=_share, initargs=(posed,))
    try:
        found = pool.submit(_work, task)
        with Progress(console=console) as bars:
            features = bars.add_task("looking for features", total=count)
            matches = bars.add_task("comparing photos", total=pairs)
            poses = bars.add_task("finding poses", total=count)
            over = False
            while not over:
                over = bool(wait([found], timeout=0.3).done)
                bars.update(features, completed=_rows(task.database, "images"))
                bars.update(matches, completed=_rows(task.database, "matches"))
                bars.update(poses, completed=posed.value)
        return found.result()
    except (RuntimeError, ValueError, IndexError, OSError) as error:
        raise UserError(f"pycolmap could not find poses: {first_line(error).rstrip('.')}.") from error
    finally:
        for process in multiprocessing.active_children():
            process.kill()
        pool.shutdown()


def _rows(database: Path, table: str) -> int:
    """Of a database that another process is writing; 0 where it cannot be read just now."""
    try:
        with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as reader:
            return reader.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
    except sqlite3.Error:
        return 0


def _share(posed: Synchronized) -> None:
    """Begin the process: `posed` counts the photos that have a pose."""
    global _posed
    _posed = posed
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value


def _work(task: Task) -> Path | None:
    """What the process does: the model with most photos, over the initial focal lengths."""
    pycolmap.set_random_seed(task.seed)
    pycolmap.extract_features(
        task.database,
        task.photos,
        image_names=list(task.names),
        camera_mode=pycolmap.CameraMode.SINGLE if task.one_lens else pycolmap.CameraMode.AUTO,
        reader_options=pycolmap.ImageReaderOptions(camera_model=task.lens),
    )
    if task.order == "any":
        pycolmap.match_exhaustive(task.database)
    else:
        pairing = pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True)
        pycolmap.match_sequential(task.database, pairing_options=pairing)
    best, most = None, 0
    for factor in FOCAL_FACTORS:
        guessed, out = _set_focal_lengths(task, factor), task.work / f"models-{factor:g}"
        for number, model in sorted(_map(task, out).items()):
            if model.num_reg_images() > most:
                best, most = out / str(number), model.num_reg_images()
        if most >= ENOUGH * len(task.names) or not guessed:
            break  # another start changes nothing where EXIF has all focal lengths
    return best


def _set_focal_lengths(task: Task, factor: float) -> bool:
    """Set the focal lengths that EXIF does not have; whether there are any."""
    with pycolmap.Database.open(task.database) as database:
        guessed = [camera for camera in database.read_all_cameras() if not camera.has_prior_focal_length]
        for camera in guessed:
            params = camera.params
            params[camera.focal_length_idxs()] = factor * max(camera.width, camera.height)
            camera.params = params
            database.update_camera(camera)
    return bool(guessed)


def _map(task: Task, out: Path) -> dict[int, pycolmap.Reconstruction]:
    """Models by the name of their folder in `out`."""

    def another() -> None:
        _posed.value += 1

    out.mkdir()
    _posed.value = 2  # a model begins with a pair, for which nothing is called
    options = pycolmap.IncrementalPipelineOptions(random_seed=task.seed, min_model_size=3)
    options.mapper.random_seed = task.seed
    places = task.database, task.photos, out
    return pycolmap.incremental_mapping(*places, options=options, next_image_callback=another)
