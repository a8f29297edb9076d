"""A method's options by their dotted names, read from text and set."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Union

import msgspec

from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.options import nearest
from abcd_ns.nerfstudio.run.settings import flat_options

PREFIX = "pipeline."  # may stand before a method's option, as in `ns-train`
_SCORED = "it would change the photos that scores are taken from"
FIXED = {
    "max_seconds": "set it with --seconds",
    "device_budget_gb": "it has no effect where the number of blocks is given; see --budgets",
    "training.seed": "set it with --seeds",
    "datamanager.data": "set it with --data",
    "datamanager.dataparser.data": "set it with --data",
    "datamanager.dataparser.downscale_factor": "set it with --downscale",
    "datamanager.dataparser.eval_mode": _SCORED,
    "datamanager.dataparser.eval_interval": _SCORED,
    "datamanager.camera_res_scale_factor": _SCORED,
}
"""Options that all runs of a folder share, and why."""
WORDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    Path: "a path",
    type(None): "none",
}
"""Types of options that can be written as one word, beside Literal, and what may be written."""


def parse_changes(text: str, pipeline: Any) -> tuple[str, ...]:
    """One or several changes, `name=value name=value`; a UserError where one does not fit `pipeline`, or may
    not be varied."""
    found, known = {}, option_names(pipeline)
    for word in text.split():
        name, equals, value = word.partition("=")
        path = name.removeprefix("--").removeprefix(PREFIX).replace("-", "_")
        if not equals or not name:
            raise UserError(f"--vary {word!r} is no change of an option; write NAME=VALUE.")
        if path in FIXED:
            raise UserError(f"{path} cannot be varied: {FIXED[path]}.")
        if path in found:
            raise UserError(f"--vary {text!r} changes {path} twice.")
        read_value(path, value, known)
        found[path] = value
    if not found:
        raise UserError(f"--vary {text!r}: change at least one option.")
    return tuple(f"{path}={value}" for path, value in found.items())


def change_options(pipeline: Any, changes: Sequence[str]) -> None:
    """Set what each `path=value` of `parse_changes` says, in place."""
    known = option_names(pipeline)
    for path, _, value in (change.partition("=") for change in changes):
        _set(pipeline, path, read_value(path, value, known))


def set_options(config: Any, values: Mapping[str, bool | int | float | str | None], where: str) -> None:
    """Set options to what the file `where` says of them, in place. What is not one word keeps its default. A
    UserError, which begins with `where`, about what does not fit."""
    known, more = option_names(config), flat_options(config)
    for path, value in values.items():
        if path in known:
            try:
                _set(config, path, read_value(path, str(value), known))
            except UserError as error:
                raise UserError(f"{where}: {error}") from None
        elif path not in more:
            raise UserError(f"{where}: there is no option {path!r} in this version of abcd_ns.")


def option_names(config: Any, prefix: str = "") -> dict[str, Any]:
    """The type of every option that can be written as one word, by its dotted name after `prefix`."""
    hints, found = typing.get_type_hints(type(config)), {}
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), prefix + field.name
        if field.name.startswith("_"):
            continue
        if dataclasses.is_dataclass(value):
            found |= option_names(value, f"{name}.")
        elif all(a in WORDS or typing.get_origin(a) is Literal for a in _alternatives(hints[field.name])):
            found[name] = hints[field.name]
    return found


def read_value(path: str, text: str, known: Mapping[str, Any]) -> Any:
    """The value that a word gives an option, by its type in `option_names`; a UserError where it does not."""
    if path not in known:
        near = " or ".join(nearest(path, known))
        said = f"did you mean {near}?" if near else "docs/reference.md lists them, under --pipeline."
        raise UserError(f"There is no option {path!r}; {said}")
    hint = known[path]
    if text.lower() == "none" and type(None) in _alternatives(hint):
        return None
    try:
        value = msgspec.convert(text, hint, strict=False, dec_hook=lambda kind, word: kind(word))
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(text)
    except ValueError:
        kinds = _alternatives(hint)
        may = [w for kind in kinds for w in ([WORDS[kind]] if kind in WORDS else typing.get_args(kind))]
        raise UserError(f"{path} is {text!r}; it must be {' or '.join(map(str, may))}.") from None
    return value


def _set(config: Any, path: str, value: Any) -> None:
    way, _, last = path.rpartition(".")
    owner = attrgetter(way)(config) if way else config
    if type(owner).__dataclass_params__.frozen:
        _set(config, way, dataclasses.replace(owner, **{last: value}))
    else:
        setattr(owner, last, value)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    if typing.get_origin(hint) in (Union, types.UnionType):
        return tuple(inner for arg in typing.get_args(hint) for inner in _alternatives(arg))
    return (hint,)
