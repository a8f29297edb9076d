"""`--load-dir` goes on from where a run was left: by a kill, a signal, a full disk. Or it says why not."""

import random
import shutil
import signal
from collections.abc import Callable
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import pytest
from nerfstudio.utils.eval_utils import eval_setup

from abcd_ns.engine.events import LayersDrawn, StepTaken
from abcd_ns.engine.store import ParameterStore, crash_points
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.errors import UserError
from abcd_ns.run.store import MadeFor
from tests.nerfstudio.crash_training import STEPS_PER_SAVE, Trainings, assert_same, gaussians, run_folder
from tests.nerfstudio.test_training import STEPS, configure, run, set_option
from tests.reference.crash_runs import Kill
from tests.reference.scenes import ring_of_views


@pytest.fixture(scope="module")
def broken_off(data, tmp_path_factory) -> Path:
    """Where a run lies that was broken off, without saving, after its first checkpoint. Read only."""
    out = tmp_path_factory.mktemp("stopped")
    run(configure(data, out), stop_after=14)
    return out


@pytest.fixture
def stopped(broken_off, tmp_path) -> Path:
    """The folder of that run, copied."""
    return run_folder(Path(shutil.copytree(broken_off, tmp_path / "stopped")))


def written(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def refusal(said_at_exit) -> Callable[..., str]:
    """What a run that cannot begin says before it exits with code 2, with nothing written."""

    def refuse(config) -> str:
        before = written(config.output_dir)
        said = said_at_exit(run, config)
        assert written(config.output_dir) == before
        assert "error:" in said
        return said

    return refuse


# Kills


def test_a_run_that_is_killed_before_its_first_checkpoint_goes_on(data, trained, tmp_path):
    options = {"kill_at_step": STEPS_PER_SAVE, "commit_seconds": 0.0}
    assert Trainings().finish(data, tmp_path / "killed", **options) == -signal.SIGKILL
    killed = run_folder(tmp_path / "killed")
    assert not list(killed.rglob("*.ckpt"))
    resumed = run(configure(data, tmp_path / "resumed", load_dir=killed / "nerfstudio_models"))
    assert 0 < resumed.resumed_from.step <= STEPS_PER_SAVE
    assert_same(resumed.base_dir, trained.base_dir)


@pytest.mark.parametrize(
    "point",
    [crash_points.CHECKPOINT_PINNED, crash_points.CHECKPOINT_WRITTEN, crash_points.CHECKPOINT_IN_PLACE],
)
def test_a_run_that_is_killed_while_it_saves_goes_on(data, trained, tmp_path, point):
    assert Trainings().finish(data, tmp_path / "killed", kill=Kill(point, 2)) == -signal.SIGKILL
    killed = run_folder(tmp_path / "killed")
    files = [path.name for path in (killed / "nerfstudio_models").iterdir()]
    assert files
    assert all(name.startswith("step-") for name in files)  # nerfstudio trips over anything else
    resumed = run(configure(data, tmp_path / "killed", load_dir=killed))  # in the same folder
    assert resumed.base_dir == killed
    assert resumed.resumed_from.step == 2 * STEPS_PER_SAVE + 1
    assert_same(killed, trained.base_dir)
    assert len(list((killed / "nerfstudio_models").iterdir())) == 1
    assert not list(killed.glob(".*"))


def test_an_older_checkpoint_can_be_asked_for(data, stopped, trained, tmp_path):
    resumed = run(configure(data, tmp_path / "b", load_dir=stopped, load_step=STEPS_PER_SAVE))
    assert (resumed.resumed_from.step, resumed.resumed_from.pin) == (STEPS_PER_SAVE + 1, "step-000000010")
    assert_same(resumed.base_dir, trained.base_dir)
    checkpoint = stopped / "nerfstudio_models" / "step-000000010.ckpt"
    again = run(configure(data, tmp_path / "c", load_checkpoint=checkpoint, steps=STEPS_PER_SAVE + 2))
    assert again.pipeline.coordinator.state.step == STEPS_PER_SAVE + 2


def test_going_back_in_the_very_folder_leaves_no_later_checkpoints(data, tmp_path, trained):
    """ns-eval would open these, and not what the run has come to since."""
    options = {"save_only_latest_checkpoint": False}
    folder = run(configure(data, tmp_path, **options), stop_after=34).base_dir
    assert saved(folder) == [10, 20, 30]
    run(configure(data, tmp_path, load_dir=folder, load_step=10, **options), stop_after=14)
    assert saved(folder) == [10]
    resumed = run(configure(data, tmp_path, load_dir=folder, **options))
    assert resumed.resumed_from.step < 20
    assert saved(folder) == [10, 20, 30, STEPS - 1]
    assert_same(folder, trained.base_dir)


def saved(folder: Path) -> list[int]:
    """The steps of a run's checkpoints, each of which has a pin."""
    names = sorted(path.stem for path in (folder / "nerfstudio_models").iterdir())
    assert sorted(ParameterStore.open(folder / "abcd/store", read_only=True).pins) == names
    return [int(name.removeprefix("step-")) for name in names]


# Signals


@pytest.mark.parametrize(("number", "event"), [(signal.SIGINT, StepTaken), (signal.SIGTERM, LayersDrawn)])
def test_a_signal_commits_and_says_how_to_go_on(
    data, trained, tmp_path, monkeypatch, said_at_exit, number, event
):
    monkeypatch.setattr("sys.argv", ["ns-train", "abcd", "--data", "wall"])
    seen = count(1)

    def interrupt(happened) -> None:
        if isinstance(happened, event) and next(seen) == 17:
            signal.raise_signal(number)

    said = said_at_exit(run, configure(data, tmp_path / "signal"), listener=interrupt, code=128 + number)
    assert f"Stopped by {number.name} after step" in said
    assert "nothing is lost" in said
    folder = run_folder(tmp_path / "signal")
    assert f"ns-train abcd --load-dir {folder}/nerfstudio_models --data wall" in said
    taken = ParameterStore.open(folder / "abcd" / "store", read_only=True).state["step"]
    assert f"after step {taken} of {STEPS}" in said
    assert taken == 17 or event is LayersDrawn
    resumed = run(configure(data, tmp_path / "resumed", load_dir=folder))
    assert resumed.resumed_from.step == taken
    assert_same(resumed.base_dir, trained.base_dir)


def test_a_second_ctrl_c_ends_a_run_in_one_line(data, tmp_path, monkeypatch, said_at_exit):
    monkeypatch.setattr("sys.argv", ["ns-train", "abcd", "--data", "wall"])
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores it

    def interrupt(happened) -> None:
        if isinstance(happened, StepTaken) and happened.step == 17:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    try:
        said = said_at_exit(run, configure(data, tmp_path / "signal"), listener=interrupt, code=130)
    finally:
        signal.signal(signal.SIGINT, before)
    assert "Stopped at once" in said
    assert f"ns-train abcd --load-dir {run_folder(tmp_path / 'signal')}/nerfstudio_models" in said


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ("nerfstudio.trainer.inspect", "Stopped before anything was written."),
        ("run.begin.stored_blocks", "Stopped before training began."),
    ],
)
def test_ctrl_c_before_the_first_step_ends_a_run_in_one_line(
    data, tmp_path, monkeypatch, said_at_exit, where, words
):
    monkeypatch.setattr("sys.argv", ["ns-train", "abcd", "--data", "wall"])
    monkeypatch.setattr(f"abcd_ns.{where}", Mock(side_effect=KeyboardInterrupt))
    said = said_at_exit(run, configure(data, tmp_path / "signal"), code=130)
    assert words in said
    assert "--load-dir" not in said


def test_going_on_for_no_more_steps_completes_the_run(data, stopped, tmp_path):
    ParameterStore.open(stopped / "abcd" / "store").close()
    before = RunState.from_json(ParameterStore.open(stopped / "abcd" / "store", read_only=True).state)
    assert before.active is not None
    resumed = run(configure(data, tmp_path / "resumed", load_dir=stopped, steps=before.step))
    state = resumed.pipeline.coordinator.state
    assert (state.active, state.step, state.pruned_at) == (None, before.step, before.step)


def test_a_checkpoint_of_another_name_can_be_viewed_only(data, stopped, tmp_path, refusal):
    (checkpoint,) = (stopped / "nerfstudio_models").iterdir()
    copied = Path(shutil.copy(checkpoint, checkpoint.with_name("my best.ckpt")))
    said = refusal(configure(data, tmp_path / "b", load_checkpoint=copied))
    assert "my best.ckpt can be viewed but not trained further" in said


# Disks


def test_a_checkpoint_that_does_not_fit_ends_the_run_with_one_line(
    data, trained, tmp_path, monkeypatch, said_at_exit
):
    def full(_, path):
        Path(path).write_bytes(b"half")
        raise RuntimeError("PytorchStreamWriter failed writing file: file write failed")

    with monkeypatch.context() as patch:
        patch.setattr("abcd_ns.nerfstudio.trainer.torch.save", full)
        said = said_at_exit(run, configure(data, tmp_path / "full"))
    assert "step-000000010.ckpt could not be written" in said
    assert "the store is safe" in said
    folder = run_folder(tmp_path / "full")
    assert not list(folder.glob(".*"))
    resumed = run(configure(data, tmp_path / "resumed", load_dir=folder))
    assert resumed.resumed_from.step == STEPS_PER_SAVE + 1
    assert_same(resumed.base_dir, trained.base_dir)


def test_a_damaged_checkpoint_is_found_and_does_not_hinder_going_on(data, stopped, trained, tmp_path):
    (checkpoint,) = (stopped / "nerfstudio_models").iterdir()
    means = gaussians(stopped)["_model.gauss_params.means"].numpy().tobytes()
    sound = checkpoint.read_bytes()
    assert sound.count(means) == 1
    start, draw = sound.index(means), random.Random(0)

    def moved(config):
        config.output_dir = stopped.parents[2]
        return config

    for offset in (start, start + len(means) - 1, start + draw.randrange(len(means))):
        checkpoint.write_bytes(sound[:offset] + bytes([sound[offset] ^ 4]) + sound[offset + 1 :])
        with pytest.raises((UserError, RuntimeError), match=r"damaged|CRC|corrupt"):
            eval_setup(stopped / "config.yml", update_config_callback=moved)
    checkpoint.write_bytes(sound[: len(sound) // 2])
    resumed = run(configure(data, tmp_path / "resumed", load_dir=stopped))
    assert_same(resumed.base_dir, trained.base_dir)


# What cannot be resumed


def test_a_folder_that_holds_a_run_is_refused_to_any_other(data, stopped, tmp_path, refusal):
    out = stopped.parents[2]
    other = run_folder(Path(shutil.copytree(out, tmp_path / "other")))
    with ParameterStore.open(stopped / "abcd" / "store"):
        assert "is being written by another run" in refusal(configure(data, out, load_dir=stopped))
    for options in ({}, {"load_dir": other}):
        said = refusal(configure(data, out, **options))
        assert f"{stopped / 'abcd' / 'store'} holds a run already: add --load-dir {stopped}" in said


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("max_num_iterations", 2, "give --max-num-iterations above that"),
        ("pipeline.blocks", 5, "was begun with --pipeline.blocks 3, not 5"),
        ("pipeline.training.sh_degree", 1, "it was made for sh degree 3, not 1"),
        ("pipeline.datamanager.dataparser.downscale_factor", 2, "it was made for photos"),
    ],
)
def test_other_options_than_the_stores_are_refused_and_both_are_shown(
    data, stopped, refusal, name, value, said
):
    """In the very folder of the run, whose config stays."""
    config = configure(data, stopped.parents[2], load_dir=stopped)
    set_option(config, name, value)
    assert said in refusal(config)


def test_other_photos_than_the_stores_are_refused_and_both_are_shown(tmp_path):
    views, photos = ring_of_views(3), [Path(f"old/{i}.png") for i in range(3)]
    mine = MadeFor.of(photos, views, TrainingConfig())
    moved = MadeFor.of([Path("new") / photo.name for photo in photos], views, TrainingConfig())
    fewer = MadeFor.of(photos[:2], views[:2], TrainingConfig())
    turned = MadeFor.of(photos, [*views[1:], views[0]], TrainingConfig())
    different = {
        f"photos {mine.photos}, not {fewer.photos}": fewer,
        r"first camera \[3\.0, .*\], not \[-1\.5": turned,
    }
    changed = {
        "blocks are trained in turn, not jointly": {"recipe": Recipe(exact=True)},
        "primitive 3dgs, not 2dgs": {"primitive": "2dgs"},
        "antialiased False, not True": {"antialiased": True},
        "light none, not affine": {"light": "affine"},
    }
    different |= {says: MadeFor.of(photos, views, TrainingConfig(**each)) for says, each in changed.items()}
    with ParameterStore.create(tmp_path / "new", mine.header()) as store:
        moved.check(store)
        for says, other in different.items():
            with pytest.raises(UserError, match=says):
                other.check(store)
    with ParameterStore.create(tmp_path / "old", {}) as store:
        mine.check(store)  # nothing was written down


def test_a_folder_without_a_run_says_so(data, tmp_path, refusal):
    folder, models = tmp_path / "run", tmp_path / "run" / "nerfstudio_models"
    models.mkdir(parents=True)
    assert "There is no run of ABCD" in refusal(configure(data, tmp_path / "out", load_dir=models))
    (models / "step-000000010.ckpt").write_bytes(b"")
    for asked in (models, folder):  # as another method leaves it
        said = refusal(configure(data, tmp_path / "out", load_dir=asked))
        assert f"{folder} can be viewed but not trained further" in said
    ParameterStore.create(folder / "abcd" / "store", {}).close()
    said = refusal(configure(data, tmp_path / "out", load_dir=models))
    assert "ended before it began: start it anew" in said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"load_step": 10}, "--load-step 10 does not say of which run: add --load-dir"),
        ({"load_checkpoint": Path("x"), "load_dir": Path("y")}, "leave out --load-dir and --load-step"),
        ({"load_checkpoint": Path("x"), "load_step": 10}, "leave out --load-dir and --load-step"),
        ({"load_checkpoint": Path("x")}, "There is no checkpoint x"),
    ],
)
def test_options_that_do_not_say_where_to_go_on_are_refused(data, tmp_path, refusal, options, said):
    assert said in refusal(configure(data, tmp_path / "out", **options))
