"""Every option that is offered has an effect; training's own: tests/engine/train/test_option_effects.py."""

from operator import attrgetter
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from abcd_ns import methods
from abcd_ns.engine.gaussians.block_state import checksum
from abcd_ns.engine.types import Gaussians
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.options import HONOURED, MIRRORED, SAME
from abcd_ns.nerfstudio.run.settings import flat_options
from tests.data.dataparser_scenes import NAMES, write_capture, write_model, write_photos
from tests.engine.train.test_option_effects import NOT_LEARNT, OTHERS, OTHERS_OF_DENSITY
from tests.nerfstudio.crash_training import gaussians
from tests.nerfstudio.test_options import refused
from tests.nerfstudio.test_training import configure, run, set_option

GROUPS = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
LEARNT = {
    "machine.seed": 7,
    "max_num_iterations": 5,
    "pipeline.blocks": 3,
    "pipeline.partition": "grid",
    "pipeline.near_plane": 4.44,  # through the wall
    "pipeline.training.point_pixels": 20.0,
    "pipeline.model.random_init": True,
    **{f"optimizers.{group}.optimizer.{name}": 0.1 for group in GROUPS for name in ("lr", "weight_decay")},
}
"""What a checkpoint of a short run differs by."""
DATA = "pipeline.datamanager.dataparser."
READ = {
    "downscale_factor": 2,
    "max_side": 20,
    "colmap_path": Path("other"),
    "images_path": Path("photos"),
    "masks_path": Path("masks"),
    "eval_mode": "all",
    "eval_interval": 3,
    "train_split_fraction": 0.5,
    "orientation_method": "none",
    "center_method": "none",
    "auto_scale_poses": False,
    "scale_factor": 2.0,
}
"""What the reader's cameras, points, photos and masks differ by."""
LOGGED = {
    "output_dir", "experiment_name", "timestamp", "method_name", "relative_model_dir", "vis", "data",
    "steps_per_save", "save_only_latest_checkpoint", "steps_per_eval_batch", "steps_per_eval_image",
    "steps_per_eval_all_images", "log_gradients", "logging.relative_log_dir", "logging.steps_per_log",
    "logging.local_writer.enable",
}  # fmt: skip
"""See `test_what_a_run_writes_follows_its_options`."""
ELSEWHERE = {
    "load_dir", "load_step", "load_checkpoint", "load_config",  # test_resume.py
    "pipeline.device_budget_gb", "pipeline.gaussian_bytes",  # tests/run/test_fit.py
    "pipeline.workers", "pipeline.cluster",  # tests/cluster
    "pipeline.ram_budget_gb", "pipeline.datamanager.photo_cache_gb",  # of memory alone
    "pipeline.max_seconds",  # test_training.py
    "pipeline.model.num_random", "pipeline.model.random_scale",  # of `random_init`
    "pipeline.model.init_splats",  # test_init_splats.py
    "pipeline.model.render", "pipeline.model.rasterizer", "pipeline.model.color_corrected_metrics",
    "machine.device_type",
    "pipeline.datamanager.data", f"{DATA}data",  # as `data`
    f"{DATA}as_stored", "pipeline.datamanager.data_format",  # which tyro does not offer
}  # fmt: skip
"""Tested with what they are about."""
OF_NERFSTUDIO = {
    "project_name", "start_paused", "logging.max_buffer_size", "logging.profiler",
    "logging.local_writer.max_log_size", "logging.local_writer.stats_to_track",
    "viewer.camera_frustum_scale", "viewer.default_composite_depth", "viewer.image_format",
    "viewer.jpeg_quality", "viewer.make_share_url", "viewer.max_num_display_images",
    "viewer.quit_on_train_completion", "viewer.websocket_host", "viewer.websocket_port",
    "viewer.websocket_port_default",
    *(f"optimizers.{group}.optimizer.eps" for group in GROUPS),  # torch's; 1e-15 is far below any gradient
}  # fmt: skip
"""Read by nerfstudio's loggers, loop and viewer, or by Adam."""


@pytest.fixture(scope="module")
def learnt(data, tmp_path_factory):
    """The checksum of the Gaussians in the checkpoint of a short run with one option changed."""

    def train(name: str | None = None, value: object = None) -> str:
        config = configure(data, tmp_path_factory.mktemp("out"), steps=6, blocks=2)
        config.pipeline.model.num_random = 300
        if name is not None:
            set_option(config, name, value)
        torch.manual_seed(config.machine.seed)  # as nerfstudio's train_loop
        scene = gaussians(run(config).base_dir)
        return checksum(Gaussians(**{name.rpartition(".")[2]: value for name, value in scene.items()}))

    return train


@pytest.fixture(scope="module")
def usual(learnt):
    return learnt()


@pytest.mark.parametrize("name", LEARNT)
def test_an_option_changes_the_checkpoint(name, learnt, usual):
    assert learnt(name, LEARNT[name]) != usual


def test_a_budget_of_ram_does_not(learnt, usual):
    assert learnt("pipeline.ram_budget_gb", 1 / 2**30) == usual


@pytest.fixture(scope="module")
def two_layouts(tmp_path_factory):
    """A capture with a second model, other photos and masks."""
    folder = tmp_path_factory.mktemp("data") / "scene"
    write_capture(folder, offset=5.0)
    write_model(folder / "other", names=NAMES[:8])
    for name in ("photos", "masks"):
        write_photos(folder / name, NAMES)
    return folder


@pytest.mark.parametrize("name", READ)
def test_an_option_of_the_reader_changes_what_is_read(name, two_layouts):
    fraction = {"eval_mode": "fraction"} if name == "train_split_fraction" else {}

    def read(**options) -> list:
        outputs = AbcdDataParserConfig(data=two_layouts, **fraction, **options).setup()
        parts = [outputs.get_dataparser_outputs(split) for split in ("train", "val")]
        look = attrgetter("cameras.camera_to_worlds", "cameras.width", "image_filenames", "mask_filenames")
        return [str(look(part)) for part in parts]

    assert read(**{name: READ[name]}) != read()


def test_what_a_run_writes_follows_its_options(data, tmp_path, capsys):
    config = configure(
        data, tmp_path / "results", steps=12, blocks=2, experiment_name="house", timestamp="first",
        method_name="abcd-mine", relative_model_dir=Path("models"), save_only_latest_checkpoint=False,
        steps_per_eval_batch=3, steps_per_eval_image=4, steps_per_eval_all_images=5, log_gradients=True,
        vis="tensorboard",
    )  # fmt: skip
    config.steps_per_save = 4
    config.logging.relative_log_dir, config.logging.steps_per_log = Path("logs"), 6
    config.logging.local_writer.enable = True
    run(config)
    folder = tmp_path / "results/house/abcd-mine/first"
    assert len(list((folder / "models").glob("step-*.ckpt"))) == 3
    (events,) = (folder / "logs").glob("events*")
    told = EventAccumulator(str(events))
    told.Reload()
    scalars = {tag: told.Scalars(tag) for tag in told.Tags()["scalars"]}
    steps = {tag: [event.step for event in events] for tag, events in scalars.items()}
    for name in ("epoch", "gaussians", "share of time for layers", "RAM (GiB)"):
        assert f"ABCD/{name}" in scalars
    warm_up, block = (event.value for event in scalars["ABCD/block"])
    assert (warm_up, block in (1, 2)) == (0, True)
    assert steps["Train Loss"] == steps["ABCD/blocks"] == [0, 6]
    assert steps["Eval Loss"] == [3, 6, 9]
    assert steps["Eval Images Metrics/psnr"] == [4, 8]
    assert steps["Eval Images Metrics Dict (all images)/psnr"][:2] == [5, 10]
    assert scalars["Train Metrics Dict/Gradients/Total"][-1].value > 0
    assert "Train Iter (time)" in capsys.readouterr().out


def test_every_option_that_is_offered_is_looked_at():
    config = methods.abcd.config
    same = [name.replace("-", "_") for flags in SAME.values() for name in flags.values()]
    of_model = {f"pipeline.model.{name}" for name in (*same, *MIRRORED)}  # are `training`'s by other names
    offered = {name for name in flat_options(config) if not refused(name)} - of_model
    offered |= {f"pipeline.model.{name}" for name in {*HONOURED} - {*MIRRORED}}
    training = {f"pipeline.training.{name}" for name in {*OTHERS, *NOT_LEARNT} - {"density"}}
    training |= {f"pipeline.training.density.{name}" for name in OTHERS_OF_DENSITY}
    looked_at = {*LEARNT, *(DATA + name for name in READ), *LOGGED, *ELSEWHERE, *OF_NERFSTUDIO, *training}
    assert offered - looked_at == set()
    assert looked_at - training - offered == set()
