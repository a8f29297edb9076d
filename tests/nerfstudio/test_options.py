"""What the command line offers of training, and what it leaves to the method and the device's memory."""

import copy

import pytest
import tyro
import yaml
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

from abcd_ns import methods
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.nerfstudio.run.settings import flat_options

METHODS = {
    found.config.method_name: found.config
    for found in vars(methods).values()
    if isinstance(found, methods.MethodSpecification)
}
HIDDEN = ("pipeline.training.recipe.", "pipeline.training.limits.")


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
    assert 0 < len(given) <= 2 * 30
    config = tyro.cli(AnnotatedBaseConfigUnion, args=[name, *given])
    assert config.pipeline.training == METHODS[name].pipeline.training


@pytest.mark.parametrize("flag", ["training.recipe.layers", "training.limits.crop-pixels", "model.ownership"])
def test_recipe_and_limits_are_no_flags(flag, capsys):
    with pytest.raises(SystemExit):
        tyro.cli(AnnotatedBaseConfigUnion, args=["abcd", f"--pipeline.{flag}", "1"])
    assert f"--pipeline.{flag}" in capsys.readouterr().err


def test_methods_differ_in_their_recipes():
    recipes = {name: config.pipeline.training.recipe for name, config in METHODS.items()}
    assert recipes.pop("abcd") == recipes.pop("abcd-monolithic") == Recipe()
    assert len({*recipes.values(), Recipe()}) == 5


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
