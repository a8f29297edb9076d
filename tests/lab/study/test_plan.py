"""Studies: what is refused before anything is written, and which runs follow from what is given."""

import copy
import math
from pathlib import Path

import pytest

from abcd_ns import methods
from abcd_ns.cli import main as cli
from abcd_ns.errors import UserError
from abcd_ns.lab.job import Change, Variant
from abcd_ns.lab.runs.configs import trainer_config
from abcd_ns.lab.runs.options import change_options, option_names, parse_variant
from abcd_ns.lab.study.command import BlocksStudy, GaussiansStudy, OptionsStudy

PIPELINE = methods.abcd.config.pipeline


def given(scene: Path, **more) -> dict:
    return {"data": scene, "out": Path("out"), "steps": 10, **more}


# Options by name


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("training.warmup=0", "training.warmup", 0.0),
        ("training.batch=1", "training.batch", 1),
        ("training.recipe.layers=false", "training.recipe.layers", False),
        ("--pipeline.blocks=27", "blocks", 27),
        ("partition=grid", "partition", "grid"),
        ("training.density.max-gaussians=500", "training.density.max_gaussians", 500),
        ("model.rasterizer=torch", "model.rasterizer", "torch"),
    ],
)
def test_a_change_is_read_by_the_type_of_its_option(text, path, value):
    variant, pipeline = parse_variant(text, PIPELINE), copy.deepcopy(PIPELINE)
    change_options(pipeline, variant)
    for step in path.split("."):
        pipeline = getattr(pipeline, step)
    assert pipeline == value
    assert type(pipeline) is type(value)


def test_several_options_may_change_at_once():
    variant = parse_variant("partition=grid blocks=27", PIPELINE)
    assert variant.changes == (Change("partition", "grid"), Change("blocks", "27"))
    assert variant.name == "partition=grid blocks=27"
    assert variant.folder == "partition=grid_blocks=27"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("training.warmpu=0.1", "no option 'training.warmpu'; did you mean training.warmup?"),
        ("warmup=0.1", "did you mean training.warmup?"),
        ("cull_alpha_thres=0.1", "did you mean training.density.cull_alpha_thresh or"),
        ("nonsense=1", "`ns-train abcd --help` lists them"),
        ("training.batch=many", "training.batch must be a whole number"),
        ("training.warmup=nan", "training.warmup must be a number"),
        ("training.recipe.layers=maybe", "training.recipe.layers must be true or false"),
        ("training.recipe.ownership=foo", "must be fragments or means"),
        ("training.ownership=means", "did you mean training.recipe.ownership"),
        ("training.seed=1", "set it with --seeds"),
        ("max_seconds=5", "set it with --seconds"),
        ("datamanager.dataparser.eval_interval=4", "would change the photos"),
        ("training.density=1", "no option 'training.density'"),
        ("_target=x", "no option '_target'"),
        ("training.warmup", "write NAME=VALUE"),
        ("=3", "write NAME=VALUE"),
        ("", "at least one option"),
        ("blocks=2 blocks=3", "none of them twice"),
    ],
)
def test_a_change_that_does_not_fit_is_refused_in_one_line(text, message):
    with pytest.raises(UserError) as caught:
        parse_variant(text, PIPELINE)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_option_of_training_can_be_named():
    names = option_names(PIPELINE)
    assert {"blocks", "training.warmup", "training.density.refine_stop", "training.background"} <= set(names)
    assert not any(part.startswith("_") for name in names for part in name.split("."))


# Plans


def test_every_variant_runs_with_every_seed_in_its_own_folder(scene):
    plan = BlocksStudy(**given(scene, seeds=(0, 1)), blocks=(4, 1, 2)).plan()
    assert [(job.seed, job.variant.name) for job in plan.jobs] == [
        (seed, f"blocks={count}") for seed in (0, 1) for count in (1, 2, 4)
    ]
    assert len({job.folder(plan.out) for job in plan.jobs}) == 6
    assert plan.jobs[0].folder(Path("out")) == Path("out/runs/abcd/blocks=1-seed-0")


@pytest.mark.parametrize(("position", "blocks"), [(0, 1), (1, 27)])
def test_a_job_trains_with_what_is_changed_and_in_its_folder(scene, position, blocks, tmp_path):
    job = BlocksStudy(**given(scene), blocks=(1, 27)).plan().jobs[position]
    config = trainer_config(job, tmp_path)
    assert config.pipeline.blocks == blocks
    config.set_timestamp()
    assert config.get_base_dir() == job.folder(tmp_path)
    assert methods.abcd.config.pipeline.blocks == 0


def test_a_study_of_gaussians_has_the_method_as_it_is_prices_limits_and_mcmc(scene):
    plan = GaussiansStudy(**given(scene, blocks=4), prices=(8, 0.5), max_gaussians=(500, 100)).plan()
    configs = [trainer_config(job, Path("out")).pipeline for job in plan.jobs]
    found = [(c.training.density.price, c.training.density.max_gaussians) for c in configs]
    assert found == [(8.0, 0), (0.5, 0), (8.0, 0), (8.0, 100), (8.0, 500), (8.0, 100), (8.0, 500)]
    assert [c.training.density.strategy for c in configs] == ["default"] * 5 + ["mcmc"] * 2
    assert {c.blocks for c in configs} == {4}
    assert "--prices 0.5 8 --max-gaussians 100 500" in plan.command
    assert not GaussiansStudy(**given(scene), prices=(), max_gaussians=()).plan().jobs[1:]
    for price in (-1.0, math.nan, math.inf):
        with pytest.raises(UserError, match=f"--prices {price:g}: a price is 0 or more"):
            GaussiansStudy(**given(scene), prices=(1.0, price)).plan()
    for prices, said in (((4.0, 1.0, 4.0), "1 4 4"), ((1.0, 1.0000001), "1 1")):  # told to six digits
        with pytest.raises(UserError, match=f"--prices {said}: give different prices"):
            GaussiansStudy(**given(scene), prices=prices).plan()


def test_an_ablation_begins_with_the_method_as_it_is(scene):
    plan = OptionsStudy(**given(scene), vary=("training.warmup=0", "training.warmup=0.35")).plan()
    assert [variant.name for variant in plan.variants] == [
        "default",
        "training.warmup=0",
        "training.warmup=0.35",
    ]
    assert plan.variants[0] == Variant()
    (note,) = plan.notes
    assert note.startswith("training.warmup=0.35 is the default")
    assert "--vary training.warmup=0 training.warmup=0.35" in plan.command


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"data": Path("nowhere")}, "--data nowhere does not exist"),
        ({"steps": None}, "either --seconds or --steps"),
        ({"seconds": 5.0}, "either --seconds or --steps"),
        ({"steps": 0}, "--steps is 0"),
        ({"downscale": 0}, "--downscale is 0"),
        ({"seeds": (1, 1)}, "--seeds 1 1: give different numbers from 0 up"),
        ({"max_gaussians": -1}, "--max-gaussians is -1"),
    ],
)
def test_conditions_out_of_range_are_refused(scene, more, message):
    with pytest.raises(UserError, match=message):
        BlocksStudy(**given(scene, **more), blocks=(1, 2)).plan()


@pytest.mark.parametrize("blocks", [(1, 65_537), (65_537, 65_538)])
def test_more_blocks_than_fit_in_memory_are_refused(scene, blocks):
    with pytest.raises(UserError, match="blocks=65537: blocks must be 1 to 65536, not 65537"):
        BlocksStudy(**given(scene), blocks=blocks).plan()


@pytest.mark.parametrize("blocks", [(), (0, 1), (2, 2), (3,)])
def test_numbers_of_blocks_must_be_several_and_different(scene, blocks):
    with pytest.raises(UserError, match=r"--blocks.* give "):
        BlocksStudy(**given(scene), blocks=blocks).plan()


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ((), "at least one change"),
        (("blocks=2", "blocks=2"), "'blocks=2' is given twice"),
        (("training.warmup=0", "training.warmup=0.0"), "'training.warmup=0' is given twice"),
        (("blocks=0",), "blocks must be 1 to 65536, not 0"),
        (("blocks=65537",), "blocks must be 1 to 65536, not 65537"),
        (("training.batch=1", "training.btach=2"), "no option 'training.btach'"),
        (("model.num_downscales=1",), "has no effect here"),
    ],
)
def test_changes_that_cannot_be_trained_are_refused(scene, vary, message):
    with pytest.raises(UserError, match=message):
        OptionsStudy(**given(scene), vary=vary).plan()


def test_a_scene_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "scene").mkdir()
    with pytest.raises(UserError):
        BlocksStudy(**given(tmp_path / "scene"), blocks=(1, 2)).plan()


def test_a_wrong_name_on_the_command_line_is_one_line_and_nothing_is_written(scene, tmp_path, capsys):
    words = ["study", "options", "--data", str(scene), "--out", str(tmp_path / "out"), "--steps", "5"]
    assert cli.main([*words, "--vary", "training.batch=1", "trainin.warmup=0"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["error: There is no option 'trainin.warmup'; did you mean training.warmup?"]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("study", ["blocks", "gaussians", "options"])
def test_help_teaches(study, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["study", study, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: abcd study {study}" in text
    for option in ("--data", "--out", "--seconds", "--steps", "--seeds", "--downscale", "--overwrite"):
        assert option in text
