"""Command lines of nerfstudio's: which are about our methods, and which options `--help` lists."""

import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig

METHODS = "abcd"
"""What the names of all our methods begin with."""
UNUSED_OF_MACHINE = dict.fromkeys(
    ("num_devices", "num_machines", "machine_rank", "dist_url"), "for several devices set --pipeline.workers"
)
"""Options of nerfstudio's machine that ABCD has no use for, and why."""


def trains_ours(words: Sequence[str]) -> bool:
    """Whether a command line is `ns-train` with a method of ours."""
    return Path(words[0]).stem == "ns-train" and len(words) > 1 and words[1].startswith(METHODS)


def opens_ours(words: Sequence[str]) -> bool:
    """Whether a command line opens a run of ours, OUTPUTS/SCENE/METHOD/TIME/config.yml: the path tells."""
    flags = [word.partition("=")[0].replace("_", "-") for word in words]
    if not Path(words[0]).stem.startswith("ns-") or "--load-config" not in flags:
        return False
    place = flags.index("--load-config")
    path = words[place].partition("=")[2] or "".join(words[place + 1 : place + 2])
    return any(part.startswith(METHODS) for part in Path(path).parts[-3:-2])


def hidden(*names: str) -> Callable[[type], type]:
    """Of a config class, above `@dataclass`: these fields are no flags; files and Python may set them."""

    def decorate(cls: type) -> type:
        hints = get_type_hints(cls, include_extras=True)
        return _annotate(cls, {name: tyro.conf.Suppress[hints[name]] for name in names})

    return decorate


def shown(*names: str) -> Callable[[type], type]:
    """Of a config class, above `@dataclass`: the fields that `ns-train abcd --help` lists, in this order.

    The other fields are flags as well. tyro lists all that it takes, so they are none while it prints help.
    """

    def decorate(cls: type) -> type:
        fields = {field.name: field for field in dataclasses.fields(cls)}
        cls.__dataclass_fields__ = {name: fields[name] for name in (*names, *fields)}
        others = [name for name in fields if name not in names and not name.startswith("_")]
        helps = trains_ours(sys.argv) and not {"-h", "--help"}.isdisjoint(sys.argv)
        return hidden(*others)(cls) if helps else cls

    return decorate


def named_too(cls: type, flags: Mapping[str, str]) -> None:
    """Give fields of a config class a second flag each, by the field's name."""
    hints = get_type_hints(cls, include_extras=True)
    second = {name: tyro.conf.arg(aliases=[flag]) for name, flag in flags.items()}
    _annotate(cls, {name: Annotated[hints[name], also] for name, also in second.items()})


def _annotate(cls: type, annotations: dict[str, Any]) -> type:
    # tyro reads annotations when it makes its command line; the class itself stays as it was.
    cls.__annotations__ = {**cls.__annotations__, **annotations}
    return cls


@shown("device_type", "seed")
@hidden(*UNUSED_OF_MACHINE)
@dataclasses.dataclass
class AbcdMachineConfig(MachineConfig):
    """nerfstudio's machine; its seed is the run's."""

    seed: int = 0
    """Seed of the order of blocks and views, of backgrounds, and of `mcmc`."""


@shown("websocket_port", "websocket_host", "quit_on_train_completion")
@hidden("num_rays_per_chunk")
@dataclasses.dataclass
class AbcdViewerConfig(ViewerConfig):
    """nerfstudio's viewer, fewer of its options in the help."""
