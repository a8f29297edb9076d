"""Command lines of nerfstudio's: which are about our methods, and which options `--help` lists."""

import dataclasses
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro
import yaml
from jaxtyping import Float
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.data.scene_box import OrientedBox
from torch import Tensor

from abcd_ns.data.input_errors import exit_on_user_error
from abcd_ns.errors import UserError

METHODS = "abcd"  # start of the names of all our methods
UNUSED_OF_VIEWER = {
    "num_rays_per_chunk": "it is about rays, and Gaussians are not drawn by rays",
    "relative_log_filename": "the viewer writes no log",
}
UNUSED_OF_MACHINE = dict.fromkeys(
    ("num_devices", "num_machines", "machine_rank", "dist_url"), "for several devices set --pipeline.workers"
)
"""Options of nerfstudio's viewer and machine that ABCD has no use for, and why."""


def trains_ours(words: Sequence[str]) -> bool:
    """Whether a command line is `ns-train` with a method of ours."""
    return Path(words[0]).stem == "ns-train" and len(words) > 1 and words[1].startswith(METHODS)


def opened(words: Sequence[str]) -> Path | None:
    """The config.yml that ns-eval, ns-viewer, ns-render or ns-export opens; None for other commands."""
    path = value_of(words, "--load-config")
    tool = Path(words[0]).stem
    return Path(path) if path and tool.startswith("ns-") and tool != "ns-train" else None


def check_config(words: Sequence[str]) -> None:
    """Raise a UserError if the config.yml of ours that a command line names is none."""
    name = value_of(words, "--load-config")
    path = Path(name or "")
    meant = path / "config.yml" if path.is_dir() else path
    if not name or not (trains_ours(words) or opens_ours([words[0], "--load-config", str(meant)])):
        return
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except OSError as error:
        refused = f"{path} cannot be read ({error.strerror})"
    except (yaml.YAMLError, UnicodeDecodeError):
        refused = f"{path} is damaged"
    else:
        if root is not None and root.tag.startswith("tag:yaml.org,2002:python/object"):
            flags = [word for word in words[2:] if word.startswith("--")]
            beside = [flag for flag in flags if not flag.startswith(("--load-config", "--load_config"))]
            if beside and trains_ours(words):
                why = "takes all options from its file, and none beside it"
                raise UserError(f"--load-config {why}: write {beside[0]} into {path}, or leave it out.")
            return
        refused = f"{path} describes no run"
    raise UserError(f"{refused}: give --load-config outputs/SCENE/METHOD/TIME/config.yml.")


def opens_ours(words: Sequence[str]) -> bool:
    """Whether a command line opens a run of ours, by the path OUTPUTS/SCENE/METHOD/TIME/config.yml."""
    path = opened(words)
    return path is not None and any(part.startswith(METHODS) for part in path.parts[-3:-2])


def as_a_command() -> AbstractContextManager:
    """Where a command opens a run, let a UserError end the process in one line. Python gets the exception;
    so does `ns-train`, which has blocks to put on disk first."""
    return nullcontext() if opened(sys.argv) is None else exit_on_user_error()


def check_tool(words: Sequence[str]) -> None:
    """Raise a UserError if a command cannot be done with a run of ours, or a path is of no use."""
    if (config := opened(words)) is None:
        return
    tool, what = Path(words[0]).stem, "".join(words[1:2])
    if tool == "ns-export" and what in ("pointcloud", "tsdf", "poisson", "marching-cubes"):
        raise UserError(f"ns-export {what} cannot draw Gaussians; `abcd mesh {config.parent}` makes a mesh.")
    if tool == "ns-render" and what == "spiral":
        raise UserError("ns-render spiral is for methods that train on rays: use ns-render interpolate.")
    out = value_of(words, "--output-path")
    if tool == "ns-eval" and out and not out.endswith(".json"):
        raise UserError(f"--output-path {out} must end in .json.")
    folders = [Path(out).parent] if out else []
    given = (value_of(words, flag) for flag in ("--output-dir", "--render-output-path"))
    folders += [Path(folder) for folder in given if folder]
    for folder in folders:  # the tools end with a traceback, ns-eval after all its work
        there = next(place for place in (folder, *folder.absolute().parents) if os.path.exists(place))
        if not there.is_dir() or not os.access(there, os.W_OK):
            why = "is read-only" if there.is_dir() else "is a file"
            raise UserError(f"{folder} cannot be made, {there} {why}: choose another folder.")
    if (path := value_of(words, "--camera-path-filename")) is not None:
        try:
            json.loads(Path(path).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            why = f"is no camera path ({error}): make one in the viewer's Render tab."
            raise UserError(f"{path} {why}") from None


def check_held_out(words: Sequence[str], held_out: int = 0) -> None:
    """Raise a UserError if a command asks for more held-out photos than there are, which is none or one."""
    tool, what = Path(words[0]).stem, "".join(words[1:2])
    flag = {"dataset": "--split", "interpolate": "--pose-source"}.get(what)
    if tool == "ns-eval" and not held_out:
        raise UserError("This run's data holds no photos out, so there is nothing to score.")
    too_few = what == "interpolate" or not held_out
    if tool == "ns-render" and flag and too_few and value_of(words, flag) != "train":
        found = "one photo" if held_out else "no photos"
        raise UserError(f"This run's data holds {found} out: add {flag} train.")


def check_box(words: Sequence[str], means: Float[Tensor, "n 3"]) -> None:
    """Raise a UserError if the box of `ns-export gaussian-splat` holds none of the means."""
    given = [value_of(words, f"--obb-{name}", 3) for name in ("center", "rotation", "scale")]
    if Path(words[0]).stem == "ns-export" and None not in given:
        box = OrientedBox.from_params(*(tuple(map(float, values.split())) for values in given))
        if not box.within(means.detach().cpu()).any():
            raise UserError("No Gaussian lies in this box: move it, or make it larger.")


def value_of(words: Sequence[str], flag: str, count: int = 1) -> str | None:
    """The `count` words that follow a flag on a command line; None without the flag."""
    flags = [word.partition("=")[0].replace("_", "-") for word in words]
    if flag not in flags:
        return None
    place = flags.index(flag)
    return words[place].partition("=")[2] or " ".join(words[place + 1 : place + 1 + count])


def hidden(*names: str) -> Callable[[type], type]:
    """Class decorator above `@dataclass`: these fields are no flags; files and Python may set them."""
    return lambda cls: annotated(cls, dict.fromkeys(names, tyro.conf.Suppress))


def shown(*names: str) -> Callable[[type], type]:
    """Class decorator above `@dataclass`: the fields that `ns-train abcd --help` lists, in this order.

    Other fields are flags too, except while help is printed: tyro lists all that it takes.
    """

    def decorate(cls: type) -> type:
        fields = {field.name: field for field in dataclasses.fields(cls)}
        cls.__dataclass_fields__ = {name: fields[name] for name in (*names, *fields)}
        others = [name for name in fields if name not in names and not name.startswith("_")]
        helps = trains_ours(sys.argv) and not {"-h", "--help"}.isdisjoint(sys.argv)
        return hidden(*others)(cls) if helps else cls

    return decorate


def annotated(cls: type, marks: Mapping[str, Any]) -> type:
    """The config class, its fields marked by name; tyro reads that when it makes its command line."""
    hints = get_type_hints(cls, include_extras=True)
    marked = {name: Annotated[hints[name], mark] for name, mark in marks.items()}
    cls.__annotations__ = {**cls.__annotations__, **marked}
    return cls


@shown("device_type", "seed")
@hidden(*UNUSED_OF_MACHINE)
@dataclasses.dataclass
class AbcdMachineConfig(MachineConfig):
    """nerfstudio's machine; its seed is the run's."""

    seed: int = 0
    """Seed of the order of blocks and views, and of backgrounds."""


@shown("websocket_port", "websocket_host", "quit_on_train_completion")
@hidden(*UNUSED_OF_VIEWER)
@dataclasses.dataclass
class AbcdViewerConfig(ViewerConfig):
    """nerfstudio's viewer, fewer of its options in the help."""
