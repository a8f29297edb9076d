"""Structure from motion by pycolmap, in a process of its own, step by step."""

import multiprocessing
import sqlite3
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Literal

import pycolmap

from abcd_ns.errors import UserError, first_line

ENOUGH = 0.9
"""Once so large a share of the photos has a pose, no other focal length is tried."""
FOCAL_FACTORS = (1.2, 0.72, 0.5)
"""Focal lengths to begin with, by the photo's longer side, where EXIF tells none: COLMAP's own guess, a
phone's main camera, a wide one. The true one is found from a start that is not too far off."""
OVERLAP = 12
"""Photos of a video are compared with so many that follow, and with some farther on."""
SECONDS_BETWEEN_LOOKS = 0.3

Order = Literal["any", "video"]
FEATURES, MATCHES, POSES = range(3)
"""What is being done."""
TABLES = {FEATURES: "images", MATCHES: "matches"}
"""Of the database: a row for all that a stage has done."""


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

    def total(self, stage: int) -> int:
        """What a stage goes through: photos, or the pairs of them that are compared, about."""
        n = len(self.names)
        if stage != MATCHES:
            return n
        return n * (n - 1) // 2 if self.order == "any" else n * OVERLAP


@dataclass(frozen=True)
class Model:
    """What came of it; the model itself is in `folder`."""

    folder: Path
    posed: tuple[str, ...]
    """Names of the photos that have a pose."""
    points: int
    error: float
    """Mean reprojection error, pixels."""


def find_poses(task: Task, show: Callable[[int, int], None]) -> Model | None:
    """Features, matches and poses; None where no two photos fit together.

    Args:
        show: is told several times a second what is being done, and how much of its total is.

    Raises:
        UserError: pycolmap raised, or its process died; the message is its own.
    """
    context = multiprocessing.get_context("spawn")
    stage, posed = context.Value("i", 0), context.Value("i", 0)
    pool = ProcessPoolExecutor(1, mp_context=context, initializer=_share, initargs=(stage, posed))
    try:
        found = pool.submit(_work, task)
        while not wait([found], SECONDS_BETWEEN_LOOKS).done:
            now = stage.value
            show(now, posed.value if now == POSES else _rows(task.database, TABLES[now]))
        return found.result()
    except (RuntimeError, ValueError, IndexError, OSError) as error:
        raise UserError(f"pycolmap could not find poses: {first_line(error)}.") from error
    finally:
        for process in multiprocessing.active_children():  # pycolmap does not listen to Ctrl-C
            process.kill()
        pool.shutdown()


def _rows(database: Path, table: str) -> int:
    """Of a database that another process is writing; 0 where it cannot be read just now."""
    try:
        with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as reader:
            return reader.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
    except sqlite3.Error:
        return 0


_shared: list[Synchronized] = []
"""Of the process: the stage, and the photos that have a pose in it."""


def _share(stage: Synchronized, posed: Synchronized) -> None:
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    _shared[:] = [stage, posed]


def _work(task: Task) -> Model | None:
    """What the process does."""
    stage, posed = _shared
    pycolmap.set_random_seed(task.seed)
    mode = pycolmap.CameraMode.SINGLE if task.one_lens else pycolmap.CameraMode.AUTO
    reader = pycolmap.ImageReaderOptions(camera_model=task.lens)
    pycolmap.extract_features(
        task.database, task.photos, image_names=list(task.names), camera_mode=mode, reader_options=reader
    )
    stage.value = MATCHES
    if task.order == "any":
        pycolmap.match_exhaustive(task.database)
    else:
        pairing = pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True)
        pycolmap.match_sequential(task.database, pairing_options=pairing)
    stage.value = POSES
    return _best_model(task, posed)


def _best_model(task: Task, posed: Synchronized) -> Model | None:
    """The model of most photos, over the focal lengths to begin with."""
    best: Model | None = None
    for factor in FOCAL_FACTORS:
        guessed = _begin_with(task, factor)
        posed.value = 0
        found = _map(task, task.work / f"models-{factor:g}", posed)
        if found is not None and (best is None or len(found.posed) > len(best.posed)):
            best = found
        enough = best is not None and len(best.posed) >= ENOUGH * len(task.names)
        if enough or not guessed:  # another start changes nothing where EXIF tells all focal lengths
            break
    return best


def _begin_with(task: Task, factor: float) -> bool:
    """Set the focal lengths that EXIF does not tell; whether there are any."""
    with pycolmap.Database.open(task.database) as database:
        guessed = [camera for camera in database.read_all_cameras() if not camera.has_prior_focal_length]
        for camera in guessed:
            params = camera.params
            for place in camera.focal_length_idxs():
                params[place] = factor * max(camera.width, camera.height)
            camera.params = params
            database.update_camera(camera)
    return bool(guessed)


def _map(task: Task, out: Path, posed: Synchronized) -> Model | None:
    def another() -> None:
        posed.value += 1

    out.mkdir()
    options = pycolmap.IncrementalPipelineOptions(random_seed=task.seed, min_model_size=3)
    options.mapper.random_seed = task.seed
    models = pycolmap.incremental_mapping(
        task.database, task.photos, out, options=options, next_image_callback=another
    )
    if not models:
        return None
    number, model = max(models.items(), key=lambda item: (item[1].num_reg_images(), -item[0]))
    names = tuple(sorted(model.image(i).name for i in model.reg_image_ids()))
    return Model(out / str(number), names, model.num_points3D(), model.compute_mean_reprojection_error())
