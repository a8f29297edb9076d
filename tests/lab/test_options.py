"""Options by their dotted names: found, read by their type, refused."""

import copy

import pytest

from abcd_ns import methods
from abcd_ns.errors import UserError
from abcd_ns.lab.runs.options import change_options, parse_changes

PIPELINE = methods.abcd.config.pipeline


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("training.warmup=0", "training.warmup", 0.0),
        ("training.recipe.layers=false", "training.recipe.layers", False),
        ("--pipeline.blocks=27", "blocks", 27),
        ("partition=grid", "partition", "grid"),
        ("training.density.max-gaussians=500", "training.density.max_gaussians", 500),
    ],
)
def test_a_change_is_read_by_the_type_of_its_option(text, path, value):
    pipeline = copy.deepcopy(PIPELINE)
    change_options(pipeline, parse_changes(text, PIPELINE))
    for step in path.split("."):
        pipeline = getattr(pipeline, step)
    assert pipeline == value
    assert type(pipeline) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("training.warmpu=0.1", "no option 'training.warmpu'; did you mean training.warmup?"),
        ("model.num_blocks=4", "did you mean blocks?"),
        ("nonsense=1", "docs/reference.md lists them"),
        ("training.batch=many", "training.batch is 'many'; it must be a whole number"),
        ("training.warmup=nan", "must be a number"),
        ("training.recipe.layers=maybe", "must be true or false"),
        ("training.recipe.ownership=foo", "must be fragments or means"),
        ("training.seed=1", "set it with --seeds"),
        ("datamanager.dataparser.eval_interval=4", "would change the photos"),
        ("_target=x", "no option '_target'"),
        ("training.warmup", "write NAME=VALUE"),
        ("", "at least one option"),
        ("blocks=2 blocks=3", "changes blocks twice"),
    ],
)
def test_a_change_that_does_not_fit_is_refused_in_one_line(text, message):
    with pytest.raises(UserError) as caught:
        parse_changes(text, PIPELINE)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
