"""Frozen dataclasses to JSON and back, with every field checked by its annotation.

Results are read again later, by people and programs that were not there: what cannot be stated in JSON (NaN,
infinity) is refused when it is written, and a file that does not fit is refused when it is read.
"""

import dataclasses
import difflib
import json
import math
import types
import typing
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from abcd_ns.errors import UserError

R = TypeVar("R")


class RecordError(UserError):
    """A file does not hold the record it should; the message names file and field."""


def decode(cls: type[R], data: Any, where: str) -> R:
    """`data`, as JSON or TOML gives it, as the dataclass `cls`.

    Args:
        where: the file that `data` comes from, and the place in it; begins every message.

    Raises:
        RecordError: a field is unknown, missing or of another type.
    """
    if not isinstance(data, dict):
        raise RecordError(f"{where} must be a table of named values, not {data!r}.")
    hints = typing.get_type_hints(cls)
    fields = {field.name: field for field in dataclasses.fields(cls)}
    for name in data:
        if name not in fields:
            close = difflib.get_close_matches(name, fields, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(fields)}."
            raise RecordError(f"{where} has an unknown field {name!r}; {hint}")
    missing = [n for n, f in fields.items() if n not in data and _is_required(f)]
    if missing:
        raise RecordError(f"{where} lacks the field {missing[0]!r}.")
    return cls(**{name: _value(hints[name], value, f"{where}: {name}") for name, value in data.items()})


def encode(record: Any) -> dict[str, Any]:
    """The record as plain JSON values.

    Raises:
        ValueError: a number is NaN or infinite; the message names the field.
    """
    data = dataclasses.asdict(record)
    for path, value in _leaves(data, ""):
        if isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"{path} is {value}, which JSON cannot hold")
    return data


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write indented JSON, so that a reader sees the old file or the new one, never a part.

    Raises:
        ValueError: a number is NaN or infinite.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    temporary.replace(path)


def read_json(path: Path) -> Any:
    """What `write_json` wrote.

    Raises:
        RecordError: the file is absent, is no JSON, or holds NaN or infinity.
    """

    def refuse(constant: str) -> None:
        raise RecordError(f"{path} holds {constant}, which is no number in JSON; delete it and run again.")

    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except FileNotFoundError:
        raise RecordError(f"{path} does not exist.") from None
    except ValueError as error:
        raise RecordError(f"{path} is not JSON ({error}); delete it and run again.") from None


def read_record(path: Path, cls: type[R], schema: int) -> R:
    """A record with a field `schema`, as `write_json` wrote it.

    Raises:
        RecordError: the file is absent, of another schema, or does not fit the schema.
    """
    data = read_json(path)
    found = data.get("schema") if isinstance(data, dict) else None
    if found != schema:
        raise RecordError(f"{path} has schema {found!r}; this version of abcd reads schema {schema}.")
    return decode(cls, data, str(path))


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _value(hint: Any, value: Any, where: str) -> Any:
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        *others, last = (arg for arg in args if arg is not type(None))
        for hint in others:
            with suppress(RecordError):
                return _value(hint, value, where)
        return _value(last, value, where)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise RecordError(f"{where} must be a list, not {value!r}.")
        return tuple(_value(args[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    if origin is dict:
        if not isinstance(value, dict):
            raise RecordError(f"{where} must be a table of named values, not {value!r}.")
        return {key: _value(args[1], item, f"{where}.{key}") for key, item in value.items()}
    if dataclasses.is_dataclass(hint):
        return decode(hint, value, where)
    return _scalar(hint, value, where)


def _scalar(hint: type, value: Any, where: str) -> Any:
    # A bool is an int in Python, and no number to whoever writes a file.
    is_bool = isinstance(value, bool)
    if hint is float and isinstance(value, (int, float)) and not is_bool:
        return float(value)
    if isinstance(value, hint) and is_bool == (hint is bool):
        return value
    name = {float: "a number", int: "a whole number", str: "a text", bool: "true or false"}[hint]
    raise RecordError(f"{where} must be {name}, not {value!r}.")


def _leaves(data: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(data, dict):
        for key, value in data.items():
            yield from _leaves(value, f"{path}.{key}" if path else str(key))
    elif isinstance(data, (list, tuple)):
        for i, value in enumerate(data):
            yield from _leaves(value, f"{path}[{i}]")
    else:
        yield path, data
