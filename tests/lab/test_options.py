"""Options by their dotted names: found, read by their type, refused."""

import copy

import pytest

from abcd_ns import methods
from abcd_ns.errors import UserError
from abcd_ns.lab.job import Change
from abcd_ns.lab.runs.options import change_options, option_names, parse_variant

PIPELINE = methods.abcd.config.pipeline


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
        ("nonsense=1", "docs/reference.md lists them"),
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
