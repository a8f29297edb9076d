"""Frozen dataclasses to JSON and back, every field checked by its annotation.

Results are read again later, by people and programs that were not there: what cannot be stated in JSON (NaN,
infinity) is refused when it is written, and a file that does not fit is refused when it is read.
"""

import dataclasses
import difflib
import json
import sys
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from abcd_ns.errors import UserError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

R = TypeVar("R")
CONFIGS = Path(__file__).resolve().parents[2] / "configs"


class RecordError(UserError):
    """A file does not hold the record it should; the message names file and field."""


def decode(cls: type[R], data: Any, where: str) -> R:
    """`data`, as JSON or TOML gives it, as the dataclass `cls`. A RecordError, which begins with `where`, the
    file of the data, if a field is missing or of another type, or there is none of that name."""
    if isinstance(data, dict):
        names = [field.name for field in dataclasses.fields(cls)]
        for name in data.keys() - set(names):
            close = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(names)}."
            raise RecordError(f"{where} has an unknown field {name!r}; {hint}")
    try:
        return msgspec.convert(data, cls)
    except msgspec.ValidationError as error:
        raise RecordError(f"{where}: {str(error).replace('`', '').replace('$.', '')}.") from None


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write indented JSON, so that a reader sees the old file or the new one, never a part. A ValueError if a
    number is NaN or infinite."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    temporary.replace(path)


def read_json(path: Path) -> Any:
    """What `write_json` wrote; a RecordError where there is no JSON, which has no NaN and no infinity."""
    try:
        return msgspec.json.decode(path.read_bytes())
    except FileNotFoundError:
        raise RecordError(f"{path} does not exist.") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RecordError(f"{path} is not JSON ({error}); delete it and run again.") from None


def read_toml(path: Path, absent: str, *, trains: bool = False) -> dict[str, Any]:
    """A user's options in TOML: for `abcd train` if it `trains`, else for a comparison. Where there is no
    such file, `small-gpu` and `configs/small-gpu.toml` are one of ours. A RecordError says `absent` where
    these have none either, or that the file is no TOML."""
    if not path.is_file() and path.parent in (Path(), Path("configs")):
        path = next((own for own in own_configs(trains) if own.stem == path.name.removesuffix(".toml")), path)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RecordError(
            f"{absent} Those that come with abcd: {', '.join(p.stem for p in own_configs(trains))}."
        ) from None
    except (ValueError, OSError) as error:
        raise RecordError(f"{path} cannot be read as TOML: {error}.") from None


def own_configs(trains: bool) -> list[Path]:
    """The option files that come with abcd: for `abcd train` those that name a method, for a comparison the
    others."""
    named = {path: "method" in tomllib.loads(path.read_text("utf-8")) for path in CONFIGS.glob("*.toml")}
    return sorted(path for path, names_one in named.items() if names_one == trains)


def read_record(path: Path, cls: type[R], schema: int) -> R:
    """A record with a field `schema`, as `write_json` wrote it; a RecordError where it is of another."""
    data = read_json(path)
    found = data.get("schema") if isinstance(data, dict) else None
    if found != schema:
        raise RecordError(f"{path} has schema {found!r}; this version of abcd reads schema {schema}.")
    return decode(cls, data, str(path))
