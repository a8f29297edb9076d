"""What docs/interface.md promises is there, and a config.yml names no class of ours that it does not list."""

import importlib
import re
from pathlib import Path

import pytest
import yaml

from abcd_ns import methods

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "interface.md").read_text()
CLASS = re.compile(r"abcd_ns(?:\.\w+)+\.[A-Z]\w+")
METHODS = [each for each in vars(methods).values() if hasattr(each, "description")]


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(abcd_ns(?:\.\w+)+)`", PAGE)) - {"abcd_ns.plugin"}))
def test_a_listed_name_imports(name):
    module, _, last = name.rpartition(".")
    assert hasattr(importlib.import_module(module), last) or importlib.import_module(name)


def test_the_classes_of_a_config_are_listed():
    named = {name for method in METHODS for name in CLASS.findall(yaml.dump(method.config))}
    section = PAGE[PAGE.index("## In a run's folder") : PAGE.index("## For Python")]
    assert named == set(CLASS.findall(section))


def test_the_methods_are_listed():
    names = [method.config.method_name for method in METHODS]
    assert names
    assert [name for name in names if f"`{name}`" not in PAGE] == []


def test_a_config_of_before_the_move_names_what_opens_it():
    old = "!!python/object:abcd_ns.plugin.config.AbcdTrainerConfig\nmethod_name: abcd\n"
    says = r"the version that trained it: abcd/settings\.json"
    with pytest.raises(yaml.constructor.ConstructorError, match=says):
        yaml.load(old, Loader=yaml.Loader)
