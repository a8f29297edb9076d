"""What a run was trained with, in `abcd/settings.json`: plain values, safe to read.

nerfstudio's config.yml names Python objects, and loading it runs what its author chose.
"""

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import msgspec
from nerfstudio.engine.trainer import TrainerConfig

from abcd_ns.engine.store.atomic import write_file
from abcd_ns.errors import UserError
from abcd_ns.machine import Machine, Versions, describe_machine, describe_versions
from abcd_ns.nerfstudio.datamanager import OUR_READER, reader_name
from abcd_ns.run import SETTINGS_FILE

SCHEMA = 1  # raised whenever a field changes its name or meaning

Plain = bool | int | float | str | None


@dataclass(frozen=True)
class Settings:
    """The whole of settings.json."""

    schema: int
    method: str
    scene: str  # the name of the folder with the data
    data: str  # the folder, as it was given
    data_path: str  # its absolute path
    begun: datetime  # when training began: UTC
    options: dict[str, Plain]  # every option by its dotted name, as on `ns-train`'s command line
    versions: Versions
    machine: Machine
    reader: str = OUR_READER  # what read the data: its name on `ns-train`'s command line


def write_settings(config: TrainerConfig, options: dict[str, Plain], folder: Path) -> None:
    """Write settings.json with these options to an existing folder; a UserError if the disk refuses."""
    data = Path(config.pipeline.datamanager.data)
    path = data.resolve()
    settings = Settings(
        schema=SCHEMA,
        method=config.method_name,
        scene=path.parent.name if path.suffix == ".json" else path.name,
        data=str(data),
        data_path=str(path),
        begun=datetime.now(timezone.utc).replace(microsecond=0),
        options=options,
        versions=describe_versions(),
        machine=describe_machine(),
        reader=reader_name(config.pipeline.datamanager.dataparser),
    )
    plain = msgspec.to_builtins(settings, enc_hook=str)  # torch's version is no plain string
    content = json.dumps(plain, indent=2, allow_nan=False)
    try:
        write_file(folder / SETTINGS_FILE, (content + "\n").encode())
    except OSError as error:
        refused = f"{folder} cannot be written to ({error.strerror})"
        raise UserError(f"{refused}: free space, or choose another --output-dir.") from error


def flat_options(config: Any) -> dict[str, Plain]:
    """Every option of a configuration by its dotted name; private ones and classes are left out."""
    return dict(_leaves(config, ""))


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Plain]]:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if not str(key).startswith("_"):
                yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, (tuple, list)):
        yield name, " ".join(map(str, value))
    elif isinstance(value, Path) or (isinstance(value, float) and not math.isfinite(value)):
        yield name, str(value)
    elif value is None or isinstance(value, (bool, int, float, str)):
        yield name, value
