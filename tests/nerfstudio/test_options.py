"""What the command line offers of training, and what it leaves to the method and the device's memory."""

import copy
import math
import re
import subprocess
import sys
from fnmatch import fnmatchcase
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import tyro
import yaml
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

from abcd_ns import methods
from abcd_ns.engine.space.partition import MAX_BLOCKS
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.options import HIDDEN as HIDDEN_OF_MODEL
from abcd_ns.nerfstudio.options import (
    MIRRORED,
    NO_FLAGS,
    UNUSED_OF_MODEL,
    check_options,
    mirror,
    refuse_flags,
)
from abcd_ns.nerfstudio.run.settings import flat_options
from abcd_ns.run.begin import grid_counts
from tests.reference.scenes import random_gaussians

METHODS = {
    found.config.method_name: found.config
    for found in vars(methods).values()
    if isinstance(found, methods.MethodSpecification)
}
HIDDEN = ("pipeline.training.recipe.", "pipeline.training.limits.", "pipeline.training.seed")


def flags(name: str) -> list[str]:
    """The options of training as words of `ns-train`, each at the value that the method has."""
    words = []
    for path, value in flat_options(METHODS[name]).items():
        if path.startswith("pipeline.training.") and not path.startswith(HIDDEN):
            words += [f"--{path.replace('_', '-')}", str(value)]
    return words


@pytest.mark.parametrize("name", METHODS)
def test_a_method_keeps_its_recipe_whatever_options_are_given(name):
    given = flags(name)
    assert len(given) == 2 * 20
    config = tyro.cli(AnnotatedBaseConfigUnion, args=[name, *given])
    assert config.pipeline.training == METHODS[name].pipeline.training


def test_recipe_and_limits_are_no_flags(capsys):
    names = "training.recipe.layers", "training.limits.crop-pixels", "model.ownership"
    words = [f"--pipeline.{name}" for name in names]
    with pytest.raises(SystemExit):
        tyro.cli(AnnotatedBaseConfigUnion, args=["abcd", *(f"{word}=1" for word in words)])
    said = capsys.readouterr().err
    assert "Unrecognized options" in said
    assert all(word in said for word in words)


def parsed(*words: str):
    """What `ns-train abcd` makes of its words."""
    return tyro.cli(AnnotatedBaseConfigUnion, args=["abcd", *words])


def refused(name: str) -> bool:
    """Whether an option has no effect here."""
    return any(fnmatchcase(f"{name}.", f"{pattern}.*") for pattern in NO_FLAGS)


@pytest.fixture(scope="module")
def help_text() -> str:
    """What `ns-train abcd --help` says, at a terminal's usual width."""
    words = [Path(sys.executable).with_name("ns-train"), "abcd", "--help"]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, check=True).stdout


@pytest.mark.cli
def test_the_help_has_at_most_forty_flags_most_used_groups_first(help_text):
    words = set(re.findall(r"--[a-z][\w.-]*", help_text)) - {"--help"}
    assert 30 < len(words) <= 40
    assert re.findall(r"^\W*(\S* ?options|subcommands)\W*$", help_text, re.MULTILINE) == [
        "options",
        "pipeline options",
        "pipeline.datamanager.dataparser options",
        "pipeline.training options",
        "pipeline.training.density options",
        "pipeline.model options",
        "machine options",
        "viewer options",
        "subcommands",
    ]
    assert {"colmap", "nerfstudio-data", "blender-data"} <= set(re.findall(r"[\w-]+", help_text))


@pytest.mark.cli
def test_what_has_no_effect_is_not_in_the_help(help_text):
    shown = {word.replace("-", "_") for word in re.findall(r"--([\w.-]+)", help_text)}
    assert {word for word in shown if refused(word)} == {"pipeline.model.camera_optimizer.mode"}  # taken


def test_the_reference_has_every_option_of_ours_and_none_that_is_not():
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference.md").read_text()
    section = page[page.index("## Options") : page.index("## Splatfacto's options")]
    rows = re.findall(r"^\| (`[^|]*`) \|", section, re.MULTILINE)
    written = {name.replace("-", "_") for row in rows for name in re.findall(r"`([\w.-]+)`", row)}
    known = set(flat_options(METHODS["abcd"]))
    written = {name if name in known else f"pipeline.{name}" for name in written}
    ours = {name for name in known if name.startswith("pipeline.")}
    not_set = ("data", "dataparser.data", "dataparser.as_stored", "data_format")
    ours -= {f"pipeline.datamanager.{name}" for name in not_set}
    mirrored = {f"pipeline.model.{name}" for name in MIRRORED}
    assert written & ours == {name for name in ours - mirrored if not refused(name)}
    assert written <= known


@pytest.mark.parametrize(
    ("word", "near"),
    [
        ("--pipeline.training.warmpu", "--pipeline.training.warmup"),
        ("--pipeline.bloks=3", "--pipeline.blocks"),
        ("--max_seconds", "--pipeline.max-seconds"),
        ("--pipeline.model.primitive", "--pipeline.training.primitive"),
        ("--pipeline.nonsense", "docs/reference.md"),
    ],
)
def test_an_unknown_option_is_refused_in_one_line_with_the_nearest_name(word, near):
    with pytest.raises(UserError) as refused:
        refuse_flags(["--data", "x", word, "1"], METHODS["abcd"])
    assert near in str(refused.value)
    assert "\n" not in str(refused.value)


def test_options_of_another_reader_are_left_to_it():
    refuse_flags(["--data", "x", "colmap", "--colmap-path", "sparse/0"], METHODS["abcd"])


def test_the_same_options_of_splatfacto_are_taken():
    model = "--pipeline.model."
    training = parsed(
        f"{model}sh-degree", "2", f"{model}ssim_lambda", "0.3", f"{model}background-color", "white",
        f"{model}cull_alpha_thresh=0.01", f"{model}refine-every", "50",
        f"{model}camera-optimizer.mode", "SO3xR3",
    ).pipeline.training  # fmt: skip
    density = training.density
    assert training.poses == "SO3xR3"
    assert (training.sh_degree, training.ssim_lambda, training.background) == (2, 0.3, "white")
    assert (density.cull_alpha_thresh, density.refine_every) == (0.01, 50)


def test_the_antialiased_mode_of_splatfacto_is_ours():
    pipeline = parsed("--pipeline.model.rasterize-mode", "antialiased").pipeline
    mirror(pipeline.training, pipeline.model)
    assert pipeline.training.antialiased
    assert pipeline.model.rasterize_mode == "antialiased"


@pytest.mark.parametrize("kind", ["none", "exposure", "affine"])
def test_where_light_is_compensated_held_out_pictures_are_corrected_too(kind):
    pipeline = parsed("--pipeline.training.light", kind).pipeline
    mirror(pipeline.training, pipeline.model)
    assert pipeline.model.color_corrected_metrics == (kind != "none")


BELOW_0 = ("blocks", "device_budget_gb", "near_plane", "ram_budget_gb", "datamanager.photo_cache_gb")


@pytest.mark.parametrize(
    ("way", "value", "says"),
    [
        ("gradient_accumulation_steps", {"means": 2}, "--pipeline.training.batch"),
        ("use_grad_scaler", True, "float32"),
        ("mixed_precision", True, "float32"),
        ("machine.num_devices", 2, "--pipeline.workers"),
        ("pipeline.training.seed", 5, "--machine.seed"),
        ("vis", "viewer_legacy", "viewer_legacy"),
        ("pipeline.datamanager.cache_images", "gpu", "--pipeline.device-budget-gb"),
        ("pipeline.datamanager.train_cameras_sampling_strategy", "fps", "shuffled"),
        ("pipeline.datamanager.max_thread_workers", 2, "--pipeline.datamanager.max-thread"),
        ("pipeline.datamanager.camera_res_scale_factor", 0.5, "--downscale-factor"),
        ("pipeline.model.stop_split_at", 99, "training.density.refine-stop"),
        ("pipeline.model.warmup_length", 7, "--pipeline.model.warmup-length"),
        ("pipeline.model.sh_degree", 1, "--pipeline.training.sh-degree"),
        ("pipeline.model.cull_alpha_thresh", 0.2, "density.cull-alpha-thresh"),
        ("pipeline.model.camera_optimizer.mode", "SO3xR3", "training.poses"),
        ("pipeline.model.collider_params", None, "collider-params"),
        ("pipeline.cluster", "10.0.0.1:6379", "needs a number of workers"),
        ("pipeline.blocks", MAX_BLOCKS + 1, "--pipeline.blocks must be 65536 or less, not 65537"),
        ("pipeline.training.batch", -1, "batch must be 0 or more"),
        ("pipeline.model.use_bilateral_grid", True, "training.light affine"),
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
    config = copy.deepcopy(METHODS["abcd"])
    parent, _, name = f"config.{way}".rpartition(".")
    setattr(attrgetter(parent)(SimpleNamespace(config=config)), name, value)
    with pytest.raises(UserError) as refused:
        check_options(config)
    assert says in str(refused.value)


def test_gradients_are_not_clipped():
    config = copy.deepcopy(METHODS["abcd"])
    check_options(config)
    config.optimizers["means"]["optimizer"].max_norm = 1.0
    with pytest.raises(UserError, match=r"means\.optimizer\.max-norm"):
        check_options(config)


@pytest.mark.parametrize(
    ("extent", "blocks"), [((1.0, 1.0, 1.0), 65_000), ((1.0, 1.0, 0.004), 65_100), ((1.0, 0.0, 0.0), 10**9)]
)
def test_a_grid_of_more_cells_than_fit_in_memory_is_refused_by_its_flag(extent, blocks):
    """It has more of them than were asked for, or as many; and that is found out soon."""
    gaussians = random_gaussians(50)
    gaussians.means[:] = torch.linspace(0, 1, 50)[:, None] * torch.tensor(extent)
    with pytest.raises(UserError, match=rf"^{blocks} blocks make .* give fewer --pipeline.blocks"):
        grid_counts(gaussians, blocks)
    assert math.prod(grid_counts(gaussians, 1000)) >= 1000


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("--pipeline.model.stop-split-at", "training.density.refine-stop"),
        ("--pipeline.model.num_downscales=2", "training.coarse"),
        ("--pipeline.model.camera-optimizer.trans-l2-penalty", "training.poses SO3xR3"),
        ("--pipeline.model.grid-shape", "training.light"),
        ("--pipeline.datamanager.cache-images", "device-budget-gb"),
        ("--gradient-accumulation-steps", "training.batch"),
        ("--mixed-precision", "float32"),
        ("--optimizers.means.scheduler.lr-final", "rates follow the run"),
        ("--pipeline.training.recipe.layers", "another method"),
        ("--pipeline.training.seed", "--machine.seed"),
        ("--machine.num-machines", "--pipeline.workers"),
        ("--optimizers.scales.optimizer.max-norm", "not clipped"),
    ],
)
def test_a_flag_of_splatfactos_that_is_none_here_is_refused_by_its_reason(word, says):
    with pytest.raises(UserError) as refused:
        refuse_flags(["--data", "x", word, "1"], METHODS["abcd"])
    assert says in str(refused.value)
    assert word.partition("=")[0].replace("_", "-") in str(refused.value)


def test_every_option_of_splatfactos_model_is_a_flag_or_refused_by_a_reason():
    for name in HIDDEN_OF_MODEL:
        assert name in UNUSED_OF_MODEL or name in MIRRORED, name


@pytest.mark.parametrize("name", METHODS)
def test_flags_that_are_offered_are_not_refused(name, capsys):
    with pytest.raises(SystemExit):
        tyro.cli(AnnotatedBaseConfigUnion, args=[name, "--help"])
    words = set(re.findall(r"--[a-z][\w.-]+", capsys.readouterr().out))
    assert len(words) > 30
    refuse_flags(sorted(words), METHODS[name])


def test_what_ns_render_sets_is_let_be():
    config = copy.deepcopy(METHODS["abcd"])
    config.pipeline.model.eval_num_rays_per_chunk = 1
    mirror(config.pipeline.training, config.pipeline.model)
    assert config.pipeline.training == METHODS["abcd"].pipeline.training


def test_our_reader_of_data_keeps_its_flags():
    config = parsed("--data", "x", "--pipeline.datamanager.dataparser.downscale-factor", "4")
    assert config.pipeline.datamanager.dataparser == AbcdDataParserConfig(downscale_factor=4)
    named = parsed("--data", "x", "abcd-data", "--downscale-factor", "4")
    assert named.pipeline.datamanager.dataparser == AbcdDataParserConfig(downscale_factor=4)
    assert named.pipeline.datamanager == config.pipeline.datamanager


def test_any_reader_of_nerfstudios_is_named_as_with_splatfacto():
    words = ("colmap", "--colmap-path", "sparse/0", "--downscale-factor", "2")
    ours, theirs = (
        tyro.cli(AnnotatedBaseConfigUnion, args=[method, "--data", "x", *words])
        for method in ("abcd", "splatfacto")
    )
    parser = ours.pipeline.datamanager.dataparser
    assert parser == theirs.pipeline.datamanager.dataparser
    assert parser.colmap_path == Path("sparse/0")
    assert ours.pipeline.datamanager.data_format is None
    assert ours.pipeline.datamanager.reader().data == Path(".")  # nerfstudio's main takes --data over
    assert parsed("nerfstudio-data").pipeline.datamanager.dataparser.load_3D_points


def test_options_of_our_reader_are_not_given_to_another(capsys):
    with pytest.raises((SystemExit, ValueError)) as refused:
        parsed("--pipeline.datamanager.dataparser.downscale-factor", "4", "colmap")
    assert "are options of abcd-data" in f"{refused.value}{capsys.readouterr().err}"


def test_other_methods_may_read_by_ours():
    config = tyro.cli(
        AnnotatedBaseConfigUnion, args=["splatfacto", "--data", "x", "abcd-data", "--eval-mode", "all"]
    )
    assert config.pipeline.datamanager.dataparser == AbcdDataParserConfig(eval_mode="all", as_stored=True)


@pytest.mark.parametrize("name", METHODS)
def test_a_recipe_is_stored_and_loaded(name):
    config = copy.deepcopy(METHODS[name])
    config.pipeline.training.limits = Limits(crop_pixels=700)
    text = yaml.dump(config)
    assert "crop_pixels: 700" in text
    assert yaml.load(text, Loader=yaml.Loader).pipeline.training == config.pipeline.training


def test_options_of_an_earlier_version_are_loaded_with_the_recipe_of_today():
    text = "!!python/object:abcd_ns.engine.train.config.TrainingConfig\nlayers: false\nwarmup: 0.5\n"
    loaded = yaml.load(text, Loader=yaml.Loader)
    assert (loaded.recipe, loaded.limits, loaded.warmup) == (Recipe(), Limits(), 0.5)
    assert isinstance(loaded, TrainingConfig)
