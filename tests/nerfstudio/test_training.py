"""ABCD through nerfstudio's own trainer and tools, in this process, on a tiny scene."""

import copy
import json
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.scripts.exporter import ExportGaussianSplat
from nerfstudio.utils.eval_utils import eval_setup
from plyfile import PlyData

from abcd_ns import methods
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.store.special_blocks import PENDING
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.datamanager import AbcdDataManager
from abcd_ns.nerfstudio.model import AbcdModel
from abcd_ns.nerfstudio.run.stopping import Stopped
from abcd_ns.nerfstudio.trainer import AbcdTrainer, AbcdTrainerConfig
from abcd_ns.run import SETTINGS_FILE

STEPS = 36


def configure(data: Path, out: Path, method=methods.abcd, *, steps: int = STEPS, blocks: int = 3, **options):
    config: AbcdTrainerConfig = copy.deepcopy(method.config)
    config.data = config.pipeline.datamanager.data = data
    config.output_dir, config.vis, config.max_num_iterations = out, "tensorboard", steps
    config.steps_per_save, config.timestamp = 10, "run"
    if config.pipeline.training.warmup:
        config.pipeline.training.warmup = 0.1  # leaves so short a run some visits
    if config.method_name != "abcd-monolithic":
        config.pipeline.blocks = blocks
    config.viewer.quit_on_train_completion = True
    for name, value in options.items():
        setattr(config, name, value)
    return config


def set_option(config, name: str, value: object) -> None:
    holder, *names = config, *name.split(".")
    for part in names[:-1]:
        holder = holder[part] if isinstance(holder, dict) else getattr(holder, part)
    setattr(holder, names[-1], value)


class BrokenOff(BaseException):
    """Ends a run without saving, as a kill would."""


def run(
    config: AbcdTrainerConfig, stop_after: int | None = None, after_step=None, listener=None
) -> AbcdTrainer:
    """Train as ns-train does; `stop_after` breaks off without saving, as a kill would.

    Args:
        after_step: called with the trainer after every step.
        listener: of the coordinator's events.
    """
    config.set_timestamp()
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    try:
        trainer.setup()
        pipeline = trainer.pipeline
        end_step = pipeline._after_step

        def watched() -> None:
            end_step()
            if after_step is not None:
                after_step(trainer)
            if trainer.step + 1 == stop_after:
                raise BrokenOff

        pipeline._after_step = watched
        if listener is not None:
            pipeline.coordinator.announce.subscribe(listener)
        if stop_after is None:
            trainer.train()
        else:
            with pytest.raises(BrokenOff):
                trainer.train()
    finally:
        if (coordinator := getattr(trainer.pipeline, "coordinator", None)) is not None:
            coordinator.scene.store.close()
    return trainer


@pytest.mark.parametrize("end", [RuntimeError, Stopped])
def test_workers_end_with_their_run_and_visits_are_saved_where_it_is_stopped(data, tmp_path, end):
    """Once at once, since whoever stops it may not wait, and once with the visits under way."""
    done = []

    def after_step(trainer: AbcdTrainer) -> None:
        for name in ("save", "await_visits", "dismiss"):
            setattr(trainer.pipeline.coordinator, name, lambda name=name: not done.append(name))
        raise end(signal.SIGINT)

    with pytest.raises(SystemExit if end is Stopped else RuntimeError):
        run(configure(data, tmp_path, blocks=1), after_step=after_step)
    assert done[-1] == "dismiss"
    assert done[:3] == ["save", "await_visits", "save"] or end is RuntimeError


def test_a_run_leaves_a_checkpoint_of_the_merged_scene(trained):
    (checkpoint,) = trained.checkpoint_dir.iterdir()
    assert checkpoint.name == f"step-{STEPS - 1:09d}.ckpt"
    state = torch.load(checkpoint, weights_only=True)
    store = ParameterStore.open(trained.base_dir / "abcd" / "store", read_only=True)
    tree = BlockTree.from_json(store.header["tree"])
    scene = StoredScene(tree, store)
    in_store = torch.cat([scene.stored_with_pending(block).means for block in range(tree.num_blocks)])
    special = [other for other in store.blocks if isinstance(other, str) and other != PENDING]
    assert all(store.counts(other) == 0 for other in special)
    assert torch.equal(state["pipeline"]["_model.gauss_params.means"], in_store)
    assert len(in_store) == trained.pipeline.coordinator.count() > 150
    assert store.pins == [checkpoint.stem]


def test_the_exported_ply_is_the_merged_scene(trained, tmp_path):
    ExportGaussianSplat(load_config=trained.base_dir / "config.yml", output_dir=tmp_path).main()
    vertices = PlyData.read(str(tmp_path / "splat.ply"))["vertex"]
    state = torch.load(next(trained.checkpoint_dir.iterdir()), weights_only=True)["pipeline"]
    means = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    assert np.array_equal(means, state["_model.gauss_params.means"].numpy())
    assert np.array_equal(vertices["opacity"], state["_model.gauss_params.opacities"][:, 0].numpy())
    assert np.array_equal(vertices["f_dc_1"], state["_model.gauss_params.features_dc"][:, 1].numpy())


def test_more_steps_go_on_from_where_a_run_ended(data, tmp_path, trained):
    longer = run(configure(data, tmp_path, load_dir=trained.checkpoint_dir, steps=STEPS + 8))
    assert longer.pipeline.coordinator.state.step == STEPS + 8
    options = json.loads((longer.base_dir / "abcd" / SETTINGS_FILE).read_text())["options"]
    assert options["max_num_iterations"] == STEPS + 8  # as asked for, not what was left of them
    assert options["pipeline.datamanager.photo_cache_gb"] == 0


def test_where_workers_train_a_checkpoint_bears_the_last_step_that_was_taken_in(data, tmp_path):
    config = configure(data, tmp_path, blocks=5, steps=40)
    config.pipeline.workers = 2
    trainer = run(config)
    assert trainer.pipeline.coordinator.trains_elsewhere
    (checkpoint,) = trainer.checkpoint_dir.iterdir()
    assert checkpoint.name == "step-000000039.ckpt"


@pytest.mark.parametrize("method", [methods.abcd_ablated, methods.abcd_partition, methods.abcd_paper])
def test_the_other_methods_train_and_load(data, tmp_path, method):
    """The report's tests train the two that are not here."""
    trainer = run(configure(data, tmp_path, method, steps=12))
    _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml")
    # A grid has at least as many cells as asked for: here 2 x 2.
    assert pipeline.model.tree.num_blocks == (4 if method is methods.abcd_paper else 3)
    assert np.isfinite(pipeline.get_average_eval_image_metrics()["psnr"])


def test_while_training_only_the_active_block_is_registered(data, tmp_path):
    config = configure(data, tmp_path)
    config.pipeline.training.warmup = 0.0
    pipeline = run(config, stop_after=2).pipeline
    active = [p.shape[0] for n, p in pipeline.model.named_parameters() if n.endswith("means")]
    assert 0 < sum(active) < pipeline.coordinator.count()


def test_a_limit_below_the_number_of_points_is_kept_from_the_start(data, tmp_path, capsys):
    config = configure(data, tmp_path, steps=8)
    config.pipeline.training.density.max_gaussians = 100
    trainer = run(config)
    assert 90 < trainer.pipeline.coordinator.count() <= 100  # some go at the end
    assert "Training begins with 100 of 278 Gaussians" in capsys.readouterr().out


def test_seconds_end_a_run(data, tmp_path):
    config = configure(data, tmp_path, steps=100_000)
    config.pipeline.max_seconds = 1.0
    trainer = run(config)
    assert trainer.pipeline.coordinator.finished
    ended = trainer.pipeline.coordinator
    assert ended.state.step < 100_000
    assert ended.state.active is None
    config = configure(data, tmp_path / "again", steps=100_000, load_dir=trainer.checkpoint_dir)
    config.pipeline.max_seconds = 1.0
    again = run(config).pipeline.coordinator
    assert (again.state.step, again.count()) == (ended.state.step, ended.count())


def test_an_output_folder_that_is_a_file_is_refused(data, tmp_path, said_at_exit):
    config = configure(data, tmp_path / "taken")
    config.output_dir.touch()
    assert "another --output-dir" in said_at_exit(run, config)
    assert [*tmp_path.rglob("*")] == [config.output_dir]


def test_no_time_counts_while_the_viewer_has_the_run_paused(data, tmp_path):
    trainers, waited = [], 0.8

    def pause(trainer):
        if not trainers:
            trainers.append(trainer)
            trainer.training_state = "paused"
            threading.Timer(waited, setattr, (trainer, "training_state", "training")).start()

    began = time.monotonic()
    trainer = run(configure(data, tmp_path, steps=6), after_step=pause)
    assert trainer.pipeline.coordinator.state.step == 6
    assert trainer.pipeline.coordinator.stopwatch.seconds < time.monotonic() - began - waited


def test_no_time_counts_while_held_out_photos_are_compared(data, tmp_path, monkeypatch):
    often = {"steps_per_eval_batch": 1, "steps_per_eval_image": 2, "steps_per_eval_all_images": 2}
    counting, shown = [], AbcdDataManager._held_out

    def watched(manager: AbcdDataManager, row: int):
        before = manager._coordinator.stopwatch.seconds
        counting.append(manager._coordinator.stopwatch.seconds > before)
        return shown(manager, row)

    monkeypatch.setattr(AbcdDataManager, "_held_out", watched)
    run(configure(data, tmp_path, steps=4, **often))
    assert len(counting) > 6
    assert not any(counting)


@pytest.mark.parametrize("kind", ["user", "signal"])
def test_what_goes_wrong_in_the_last_scoring_ends_the_run_at_once(
    data, tmp_path, monkeypatch, said_at_exit, kind
):
    scored = []

    def fails(self, outputs, batch):
        scored.append(batch)
        if kind == "user":
            raise UserError("AlexNet's weights could not be fetched.")
        signal.raise_signal(signal.SIGINT)
        return score(self, outputs, batch)

    score = AbcdModel.get_image_metrics_and_images
    monkeypatch.setattr(AbcdModel, "get_image_metrics_and_images", fails)
    config = configure(data, tmp_path, steps=4)
    config.steps_per_eval_all_images = 1000
    said_at_exit(run, config, code=2 if kind == "user" else 130)
    assert len(scored) == 1
