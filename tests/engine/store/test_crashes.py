"""A run that is killed and resumed is the run that was not, bit for bit; so is one that a disk refused."""

import random

import pytest

from abcd_ns.engine.store import ParameterStore, crash_points
from tests.reference.crash_runs import DISK_FULL, STEPS, Kill, Runs, digest, lost_steps, points_reached


@pytest.fixture(scope="module")
def runs() -> Runs:
    return Runs()


@pytest.fixture(scope="module")
def undisturbed(runs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    assert runs.finish(folder) == 0
    assert ParameterStore.open(folder / "store", read_only=True).state["step"] == STEPS
    return folder


@pytest.mark.parametrize("trial", range(2))
def test_a_run_killed_at_any_time_ends_as_it_would_have(runs, undisturbed, tmp_path, trial):
    seconds, folder = random.Random(trial).uniform(0.1, 2.0), tmp_path / "first"
    folder.mkdir()
    while runs.finish(folder, within=seconds) == 0:  # it was done by then: earlier, and from the start
        seconds, folder = seconds / 2, folder.with_name(f"after-{seconds / 2:.4f}")
        folder.mkdir()
    assert lost_steps(folder) == 0
    assert runs.finish(folder) == 0
    assert digest(folder) == digest(undisturbed), seconds


@pytest.mark.parametrize(
    ("point", "nth", "commit_seconds"),
    [
        (crash_points.SHARDS_IN_PLACE, 4, 0.0),
        (crash_points.VISIT_TRAINED, 2, 0.0),
        # While it writes beside the training.
        (crash_points.FILE_WRITTEN, 9, 0.02),
        (crash_points.FILE_IN_PLACE, 9, 0.02),
        (crash_points.GENERATION_PUBLISHED, 9, 0.02),
        (crash_points.SHARD_DELETED, 9, 0.02),
    ],
)
def test_a_run_killed_at_a_bad_moment_ends_as_it_would_have(
    runs, undisturbed, tmp_path, point, nth, commit_seconds
):
    options = {"commit_seconds": commit_seconds}
    assert runs.finish(tmp_path, kill=Kill(point, nth), **options) == -9
    assert lost_steps(tmp_path) == 0
    if point == crash_points.VISIT_TRAINED:  # and again, as it is cloned
        assert runs.finish(tmp_path, kill=Kill(crash_points.SHARDS_LINKED), **options) == -9
    assert runs.finish(tmp_path, **options) == 0
    assert digest(tmp_path) == digest(undisturbed)


def test_a_run_that_the_disk_refuses_goes_on_when_there_is_room(runs, undisturbed, tmp_path):
    largest = max(path.stat().st_size for path in (undisturbed / "store").glob("*.safetensors"))
    assert runs.finish(tmp_path, file_bytes=largest - 1) == DISK_FULL
    (line,) = (tmp_path / "error.txt").read_text().splitlines()
    assert "failed" in line
    assert "intact: free space" in line
    assert lost_steps(tmp_path) == 0
    assert runs.finish(tmp_path) == 0
    assert digest(tmp_path) == digest(undisturbed)


def test_a_run_reaches_every_point_at_which_it_can_be_killed(tmp_path):
    begun, resumed = points_reached(tmp_path), points_reached(tmp_path)
    points = {point for name, point in vars(crash_points).items() if name.isupper()}
    of_checkpoints = {point for point in points if point.startswith("checkpoint")}
    assert begun | resumed == points - of_checkpoints != points
