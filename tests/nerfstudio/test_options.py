"""What the command line offers of training, and what it leaves to the method and the device's memory."""

import copy
import importlib
import io
import math
import os
import re
import sys
from contextlib import redirect_stdout, suppress
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from tyro.conf import FlagConversionOff, SuppressFixed

from abcd_ns import methods
from abcd_ns.engine.space.partition import MAX_BLOCKS
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.options import MIRRORED, NO_FLAGS, check_options, mirror, refuse_flags
from abcd_ns.nerfstudio.run.settings import flat_options
from abcd_ns.run.begin import grid_counts
from tests.nerfstudio.forks import forget, in_a_fork
from tests.nerfstudio.test_training import set_option

OURS = methods.abcd.config


def parsed(*words: str, method: str = "abcd"):
    return tyro.cli(AnnotatedBaseConfigUnion, args=[method, *words])


def refused(name: str) -> bool:
    """Whether an option has no effect here."""
    return any(fnmatchcase(f"{name}.", f"{pattern}.*") for pattern in NO_FLAGS)


@pytest.fixture(scope="module")
def help_text() -> str:
    """What `ns-train abcd --help` says, at a terminal's usual width."""

    def say() -> str:
        sys.argv, os.environ["COLUMNS"] = ["ns-train", "abcd", "--help"], "80"
        forget("abcd_ns")  # what is in the help is decided when classes are made
        config = importlib.import_module("abcd_ns.methods").abcd.config
        said = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
        with redirect_stdout(said), suppress(SystemExit):
            shown = SuppressFixed[FlagConversionOff[type(config)]]  # as in AnnotatedBaseConfigUnion
            tyro.cli(shown, args=["--help"], default=config)
        said.seek(0)
        return said.read()

    return in_a_fork(say)


def test_the_help_has_at_most_forty_flags(help_text):
    words = set(re.findall(r"--[a-z][\w.-]*", help_text)) - {"--help"}
    assert 30 < len(words) <= 40
    assert {"colmap", "nerfstudio-data", "blender-data"} <= set(re.findall(r"[\w-]+", help_text))


def test_what_has_no_effect_is_not_in_the_help(help_text):
    shown = {word.replace("-", "_") for word in re.findall(r"--([\w.-]+)", help_text)}
    assert {word for word in shown if refused(word)} == {"pipeline.model.camera_optimizer.mode"}  # taken
    refuse_flags(sorted(f"--{word}" for word in shown), OURS)


def test_the_reference_has_every_option_of_ours_and_none_that_is_not():
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference.md").read_text()
    section = page[page.index("## Options") : page.index("## Splatfacto's options")]
    rows = re.findall(r"^\| (`[^|]*`) \|", section, re.MULTILINE)
    written = {name.replace("-", "_") for row in rows for name in re.findall(r"`([\w.-]+)`", row)}
    known = set(flat_options(OURS))
    written = {name if name in known else f"pipeline.{name}" for name in written}
    ours = {name for name in known if name.startswith("pipeline.")}
    not_set = ("data", "dataparser.data", "dataparser.as_stored", "data_format")
    ours -= {f"pipeline.datamanager.{name}" for name in not_set}
    mirrored = {f"pipeline.model.{name}" for name in MIRRORED}
    assert written & ours == {name for name in ours - mirrored if not refused(name)}
    assert written <= known


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("--pipeline.training.warmpu", "--pipeline.training.warmup"),
        ("--pipeline.bloks=3", "--pipeline.blocks"),
        ("--max_seconds", "--pipeline.max-seconds"),
        ("--pipeline.model.primitive", "--pipeline.training.primitive"),
        ("--pipeline.nonsense", "docs/reference.md"),
        ("--pipeline.model.camera-optimizer.trans-l2-penalty", "training.poses SO3xR3"),
        ("--pipeline.model.grid-shape", "training.light"),
        ("--optimizers.means.scheduler.lr-final", "rates follow the run"),
        ("--optimizers.means.scheduler", "rates follow the run"),
        ("--pipeline.training.recipe.layers", "another method"),
        ("--machine.num-machines", "--pipeline.workers"),
    ],
)
def test_a_flag_that_is_none_here_is_refused_in_one_line_with_the_nearest_name_or_the_reason(word, says):
    with pytest.raises(UserError) as refused:
        refuse_flags(["--data", "x", word, "1"], OURS)
    assert says in str(refused.value)
    assert word.partition("=")[0].replace("_", "-") in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_same_options_of_splatfacto_are_taken_and_the_recipe_is_the_methods():
    model = "--pipeline.model."
    pipeline = parsed(
        f"{model}sh-degree", "2", f"{model}ssim_lambda", "0.3", f"{model}background-color", "white",
        f"{model}cull_alpha_thresh=0.01", f"{model}refine-every", "50",
        f"{model}camera-optimizer.mode", "SO3xR3", f"{model}rasterize-mode", "antialiased",
        "--pipeline.training.light", "affine", method="abcd-paper",
    ).pipeline  # fmt: skip
    training, density = pipeline.training, pipeline.training.density
    mirror(training, pipeline.model)
    assert training.poses == "SO3xR3"
    assert (training.sh_degree, training.ssim_lambda, training.background) == (2, 0.3, "white")
    assert (density.cull_alpha_thresh, density.refine_every) == (0.01, 50)
    assert training.antialiased
    assert pipeline.model.rasterize_mode == "antialiased"
    assert pipeline.model.color_corrected_metrics  # held-out photos have a light of their own, too
    assert training.recipe == methods.abcd_paper.config.pipeline.training.recipe


OF_TRAINING = ("batch", "point_pixels", "commit_seconds", "density.min_contribution", "density.refine_every")
BELOW_0 = ("blocks", "device_budget_gb", "near_plane", "ram_budget_gb", "datamanager.photo_cache_gb")
BELOW_0 += tuple(f"training.{name}" for name in OF_TRAINING)


@pytest.mark.parametrize(
    ("way", "value", "says"),
    [
        ("gradient_accumulation_steps", {"means": 2}, "--pipeline.training.batch"),
        ("mixed_precision", True, "float32"),
        ("machine.num_devices", 2, "--pipeline.workers"),
        ("pipeline.training.seed", 5, "--machine.seed"),
        ("vis", "viewer_legacy", "viewer_legacy"),
        ("viewer.relative_log_filename", "x.txt", "the viewer writes no log"),
        ("viewer.num_rays_per_chunk", 1, "not drawn by rays"),
        ("pipeline.datamanager.cache_images", "gpu", "--pipeline.device-budget-gb"),
        ("optimizers.means.optimizer.max_norm", 1.0, "means.optimizer.max-norm"),
        ("pipeline.model.stop_split_at", 99, "training.density.refine-stop"),
        ("pipeline.model.sh_degree", 1, "--pipeline.training.sh-degree"),
        ("pipeline.model.cull_alpha_thresh", 0.2, "density.cull-alpha-thresh"),
        ("pipeline.model.camera_optimizer.mode", "SO3xR3", "training.poses"),
        ("pipeline.cluster", "10.0.0.1:6379", "needs a number of workers"),
        ("pipeline.blocks", MAX_BLOCKS + 1, "--pipeline.blocks must be 65536 or less, not 65537"),
        ("pipeline.training.ssim_lambda", 1.5, "ssim-lambda must be from 0 to 1"),
        ("pipeline.model.num_random", -1, "num-random must be 0 or more"),
        ("max_num_iterations", 0, "--max-num-iterations must be 1 or more"),
        ("pipeline.training.recipe", Recipe(overlap=0.2), "recipe.overlap is 0.2"),
        *(("pipeline.training.warmup", share, "--pipeline.training.warmup") for share in (1.0, math.nan)),
        *(("pipeline.training.sh_degree", n, "training.sh-degree must be from 0 to 3") for n in (-1, 4)),
        *(
            (f"pipeline.{way}", value, f"--pipeline.{way.replace('_', '-')} must be 0 or more and finite")
            for way in BELOW_0
            for value in (-1, math.nan, math.inf)
        ),
        *(
            ("pipeline.max_seconds", value, "--pipeline.max-seconds must be above 0 and finite")
            for value in (-1.0, 0.0, math.nan, math.inf)
        ),
    ],
)
def test_what_has_no_effect_or_cannot_be_is_refused_from_files_too(way, value, says):
    config = copy.deepcopy(OURS)
    check_options(config)
    set_option(config, way, value)
    with pytest.raises(UserError) as refused:
        check_options(config)
    assert says in str(refused.value)


@pytest.mark.parametrize(
    ("extent", "blocks"), [((1.0, 1.0, 1.0), 65_000), ((1.0, 1.0, 0.004), 65_100), ((1.0, 0.0, 0.0), 10**9)]
)
def test_a_grid_of_more_cells_than_fit_in_memory_is_refused_by_its_flag(extent, blocks):
    """It has more of them than were asked for, or as many; and that is found out soon."""
    means = torch.linspace(0, 1, 50)[:, None] * torch.tensor(extent)
    with pytest.raises(UserError, match=rf"^{blocks} blocks make .* give fewer --pipeline.blocks"):
        grid_counts(means, blocks)
    assert math.prod(grid_counts(means, 1000)) >= 1000


def test_any_reader_of_nerfstudios_is_named_as_with_splatfacto(capsys):
    words = ("--data", "x", "colmap", "--colmap-path", "sparse/0", "--downscale-factor", "2")
    refuse_flags(words, OURS)
    ours, theirs = (parsed(*words, method=method) for method in ("abcd", "splatfacto"))
    parser = ours.pipeline.datamanager.dataparser
    assert parser == theirs.pipeline.datamanager.dataparser
    assert parser.colmap_path == Path("sparse/0")
    assert ours.pipeline.datamanager.data_format is None
    assert parsed("nerfstudio-data").pipeline.datamanager.dataparser.load_3D_points
    with pytest.raises((SystemExit, ValueError)) as refused:
        parsed("--pipeline.datamanager.dataparser.downscale-factor", "4", "colmap")
    assert "are options of abcd-data" in f"{refused.value}{capsys.readouterr().err}"


def test_our_reader_may_be_named_and_serves_other_methods():
    ours = parsed("--pipeline.datamanager.dataparser.downscale-factor", "4").pipeline.datamanager
    assert ours.dataparser == AbcdDataParserConfig(downscale_factor=4)
    assert parsed("abcd-data", "--downscale-factor", "4").pipeline.datamanager == ours
    theirs = parsed("--data", "x", "abcd-data", "--eval-mode", "all", method="splatfacto")
    parser = theirs.pipeline.datamanager.dataparser
    assert parser == AbcdDataParserConfig(eval_mode="all", as_stored=True)


@pytest.mark.parametrize("given", [".", "..", "../a.room", "transforms.json"])
def test_a_run_is_named_by_its_folder_however_that_is_given(given, tmp_path, monkeypatch):
    folder = tmp_path / "a.room"
    (folder / "images").mkdir(parents=True)
    (folder / "transforms.json").touch()
    monkeypatch.chdir(folder / "images" if given == ".." else folder)
    config = copy.deepcopy(OURS)
    config.pipeline.datamanager.data, config.timestamp = Path(given), "now"
    assert config.get_base_dir() == Path("outputs/a/abcd/now")


def test_options_of_an_earlier_version_are_loaded_with_the_recipe_of_today():
    text = "!!python/object:abcd_ns.engine.train.config.TrainingConfig\nlayers: false\nwarmup: 0.5\n"
    loaded = yaml.load(text, Loader=yaml.Loader)
    assert (loaded.recipe, loaded.limits, loaded.warmup) == (Recipe(), Limits(), 0.5)
    assert isinstance(loaded, TrainingConfig)
