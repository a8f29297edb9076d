"""What a run's options say: those that differ from the defaults, and the command that trains it again."""

import shlex

from abcd_ns.cli.report.run_folder import registered_config
from abcd_ns.errors import UserError
from abcd_ns.machine import without_home
from abcd_ns.nerfstudio.datamanager import OUR_READER
from abcd_ns.nerfstudio.options import MIRRORED, mirror
from abcd_ns.nerfstudio.run.settings import Plain, Settings, flat_options

READER = "pipeline.datamanager.dataparser."
OF_THE_PLACE = {
    *("data", "experiment_name", "load_checkpoint", "load_config", "load_dir", "load_step", "output_dir"),
    *("machine.device_type", "pipeline.datamanager.data", f"{READER}data", "timestamp"),
}
"""Options that say where a run was made and kept, not how it was trained."""
TAKEN_OVER = {"pipeline.training.seed", *(f"pipeline.model.{name}" for name in MIRRORED)}
"""Options that follow others."""
NO_FLAGS = ("pipeline.training.recipe.", "pipeline.training.limits.")
"""Prefixes of what is no option of `ns-train`: the method sets it, or the device's memory."""


def changed_options(settings: Settings) -> list[tuple[str, str, str]]:
    """Name, value and default of options that differ from the defaults; none of an unknown method."""
    try:
        config = registered_config(settings)
    except UserError:
        return []
    mirror(config.pipeline.training, config.pipeline.model)
    defaults, passed_over = flat_options(config), OF_THE_PLACE | TAKEN_OVER
    return [
        (name, as_text(value), as_text(defaults.get(name)))
        for name, value in settings.options.items()
        if name not in passed_over and (name not in defaults or defaults[name] != value)
    ]


def training_command(settings: Settings) -> str:
    """The command line that trains the run again, an option a line."""
    words, of_reader = [["ns-train", settings.method, "--data", settings.data]], []
    for name, value, _ in changed_options(settings):
        if settings.reader != OUR_READER and name.startswith(READER):
            # Options of another reader of data stand after its name, without a prefix.
            of_reader.append([_flag(name.removeprefix(READER)), value])
        elif not name.startswith(NO_FLAGS):
            words.append([_flag(name), value])
    if settings.reader != OUR_READER:
        words += [[settings.reader], *of_reader]
    return " \\\n  ".join(map(shlex.join, words))


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def as_text(value: Plain) -> str:
    """A value as it stands on a command line, without the name of anyone's home."""
    return without_home(str(value))
