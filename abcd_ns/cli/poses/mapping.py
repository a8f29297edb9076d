"""Structure from motion by pycolmap, in a process of its own, as pycolmap stops late at Ctrl-C."""

import multiprocessing
import sqlite3
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Literal

import pycolmap
from rich.console import Console
from rich.progress import Progress

from abcd_ns.errors import UserError, first_line

ENOUGH = 0.9
"""Once this share of the photos has a pose, no other focal length is tried."""
FOCAL_FACTORS = (1.2, 0.72, 0.5)
"""Initial focal lengths, by the photo's longer side, where EXIF has none: COLMAP's own guess, a phone's main
camera, a wide one. Bundle adjustment finds the true one from a start that is not too far off."""
OVERLAP = 12
"""Photos of a video are matched with that many that follow, and with some farther on."""

Order = Literal["any", "video"]


@dataclass(frozen=True)
class Task:
    """What is to be posed."""

    photos: Path
    names: tuple[str, ...]
    work: Path
    """A folder for the database and models."""
    lens: str
    """COLMAP's camera model."""
    one_lens: bool
    """Whether all photos were taken with one lens at one focal length."""
    order: Order
    seed: int = 0

    @property
    def database(self) -> Path:
        return self.work / "database.db"


def find_poses(task: Task, console: Console) -> Path | None:
    """Features, matches and poses, with a progress bar each; the model's folder, None where no photos match.

    Raises:
        UserError: pycolmap raised, or its process died; the message is its own.
    """
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
        raise UserError(f"pycolmap could not find poses: {first_line(error)}.") from error
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
    _posed.value = 0
    options = pycolmap.IncrementalPipelineOptions(random_seed=task.seed, min_model_size=3)
    options.mapper.random_seed = task.seed
    places = task.database, task.photos, out
    return pycolmap.incremental_mapping(*places, options=options, next_image_callback=another)
