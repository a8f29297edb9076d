"""A method's options by their dotted names: found, read from text by their type, and set."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Union

import msgspec

from abcd_ns.errors import UserError
from abcd_ns.lab.job import Change, Variant
from abcd_ns.nerfstudio.options import nearest

PREFIX = "pipeline."
"""May stand before a name, as in `ns-train`'s options."""
SET_BY_THE_PROTOCOL = {
    "max_seconds": "--seconds",
    "training.seed": "--seeds",
    "datamanager.data": "--data",
    "datamanager.dataparser.data": "--data",
    "datamanager.dataparser.downscale_factor": "--downscale",
}
"""Options that all runs of a folder share, and what sets them."""
HELD_OUT = {
    "datamanager.dataparser.eval_mode",
    "datamanager.dataparser.eval_interval",
    "datamanager.camera_res_scale_factor",
}
"""Options that decide which photos scores are taken from, and of what size."""
SCALARS = (bool, int, float, str, Path)
WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", Path: "a path"}


def parse_variant(text: str, pipeline: Any) -> Variant:
    """One or several changes, `name=value name=value`, each checked against the options of `pipeline`.

    Raises:
        UserError: a name or value does not fit.
    """
    changes = []
    for word in text.split():
        name, equals, value = word.partition("=")
        if not equals or not name:
            raise UserError(f"--vary {word!r} is no change of an option; write NAME=VALUE.")
        change = Change(name.removeprefix("--").removeprefix(PREFIX).replace("-", "_"), value)
        read_value(change, pipeline)
        changes.append(change)
    if len({change.path for change in changes}) < max(len(changes), 1):
        raise UserError(f"--vary {text!r}: change at least one option, and none of them twice.")
    return Variant(tuple(changes))


def change_options(pipeline: Any, variant: Variant) -> None:
    """Set what the variant changes, in place.

    Raises:
        UserError: a name or value does not fit.
    """
    for change in variant.changes:
        _set(pipeline, change.path, read_value(change, pipeline))


def set_options(config: Any, values: Mapping[str, bool | int | float | str | None], where: str) -> None:
    """Set options to what a file says of them, in place. What is not one word keeps its default.

    Args:
        where: the file; begins every message.

    Raises:
        UserError: there is no such option, or the value is not of its type.
    """
    known = option_names(config)
    for path, value in values.items():
        if path not in known and not _leads_somewhere(config, path):
            raise UserError(f"{where}: there is no option {path!r} in this version of abcd_ns.")
        if path not in known:
            continue
        try:
            _set(config, path, _read(known[path], str(value)))
        except ValueError:
            raise UserError(f"{where}: {path} is {value!r}; it must be {_words(known[path])}.") from None


def option_names(config: Any, prefix: str = "") -> dict[str, Any]:
    """The type of every option that can be written as one word, by its dotted name.

    Args:
        prefix: begins every name.
    """
    hints, found = typing.get_type_hints(type(config)), {}
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), prefix + field.name
        if field.name.startswith("_"):
            continue
        if dataclasses.is_dataclass(value):
            found |= option_names(value, f"{name}.")
        elif _is_a_word(hints[field.name]):
            found[name] = hints[field.name]
    return found


def read_value(change: Change, pipeline: Any) -> Any:
    """The value of a change, by the type of its option.

    Raises:
        UserError: there is no such option, it is the protocol's, or the value is not of its type.
    """
    if change.path in SET_BY_THE_PROTOCOL:
        flag = SET_BY_THE_PROTOCOL[change.path]
        raise UserError(f"{change.path} cannot be varied: it is the same in all runs; set it with {flag}.")
    if change.path in HELD_OUT:
        raise UserError(
            f"{change.path} cannot be varied: it would change the photos that scores are taken from."
        )
    known = option_names(pipeline)
    if change.path not in known:
        near = " or ".join(nearest(change.path, known))
        hint = f"did you mean {near}?" if near else "docs/reference.md lists them, under --pipeline."
        raise UserError(f"There is no option {change.path!r}; {hint}")
    try:
        return _read(known[change.path], change.value)
    except ValueError:
        words = _words(known[change.path])
        raise UserError(f"{change} does not fit: {change.path} must be {words}.") from None


def _set(config: Any, path: str, value: Any) -> None:
    way, _, last = path.rpartition(".")
    owner = attrgetter(way)(config) if way else config
    if type(owner).__dataclass_params__.frozen:
        _set(config, way, dataclasses.replace(owner, **{last: value}))
    else:
        setattr(owner, last, value)


def _leads_somewhere(config: Any, path: str) -> bool:
    """Whether the path is that of a value that is not one word, or of a part of one."""
    for step in path.split("."):
        if not dataclasses.is_dataclass(config):
            return True
        if not hasattr(config, step):
            return False
        config = getattr(config, step)
    return True


def _alternatives(hint: Any) -> tuple[Any, ...]:
    if typing.get_origin(hint) in (Union, types.UnionType):
        return tuple(inner for arg in typing.get_args(hint) for inner in _alternatives(arg))
    return (hint,)


def _is_a_word(hint: Any) -> bool:
    alternatives = [a for a in _alternatives(hint) if a is not type(None)]
    return bool(alternatives) and all(a in SCALARS or typing.get_origin(a) is Literal for a in alternatives)


def _read(hint: Any, text: str) -> Any:
    """The value that a word says, by the option's type.

    Raises:
        ValueError: it says none.
    """
    if text.lower() == "none" and type(None) in _alternatives(hint):
        return None
    value = msgspec.convert(text, hint, strict=False, dec_hook=lambda kind, word: kind(word))
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{text} is no setting of anything here")
    return value


def _words(hint: Any) -> str:
    words = []
    for alternative in _alternatives(hint):
        if alternative is type(None):
            words.append("none")
        elif typing.get_origin(alternative) is Literal:
            words += map(str, typing.get_args(alternative))
        else:
            words.append(WORDS[alternative])
    return " or ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)
