"""What a run's options say: those that differ from the defaults, and the command that trains it again."""

import shlex
from dataclasses import dataclass, replace

from abcd_ns.cli.report.run_folder import default_config
from abcd_ns.machine import without_home
from abcd_ns.nerfstudio.datamanager import OUR_READER
from abcd_ns.nerfstudio.options import MIRRORED
from abcd_ns.nerfstudio.run.settings import Plain, Settings, flat_options

ABOUT_THE_PLACE = {
    "data",
    "experiment_name",
    "load_checkpoint",
    "load_config",
    "load_dir",
    "load_step",
    "machine.device_type",
    "output_dir",
    "pipeline.datamanager.data",
    "pipeline.datamanager.dataparser.data",
    "timestamp",
}
"""Options that say where a run was made and kept, not how it was trained."""
TAKEN_OVER = {f"pipeline.model.{name}" for name in MIRRORED}
"""Options that follow others."""
READER = "pipeline.datamanager.dataparser."
NO_FLAGS = ("pipeline.training.recipe.", "pipeline.training.limits.")
"""What these begin is no option of `ns-train`; the method sets it, or the device's memory."""


@dataclass(frozen=True)
class Changed:
    """An option that is not at its default."""

    name: str
    value: str
    default: str

    @property
    def words(self) -> list[str]:
        """As on `ns-train`'s command line."""
        return [f"--{self.name.replace('_', '-')}", self.value]


def changed_options(settings: Settings) -> list[Changed]:
    """Options that differ from this version's defaults; of a method that it has not, none are known."""
    config = default_config(settings.method, settings.reader)
    if config is None:
        return []
    defaults, passed_over = flat_options(config), ABOUT_THE_PLACE | TAKEN_OVER
    return [
        Changed(name, as_text(value), as_text(defaults.get(name)))
        for name, value in settings.options.items()
        if name not in passed_over and (name not in defaults or defaults[name] != value)
    ]


def training_command(settings: Settings) -> str:
    """The command line that trains the run again, an option a line."""
    changed = [c for c in changed_options(settings) if not c.name.startswith(NO_FLAGS)]
    # Options of another reader of data stand after its name, without a prefix.
    readers = () if settings.reader == OUR_READER else tuple(c for c in changed if c.name.startswith(READER))
    words = [["ns-train", settings.method, "--data", settings.data]]
    words += [c.words for c in changed if c not in readers]
    if settings.reader != OUR_READER:
        words.append([settings.reader])
    words += [replace(c, name=c.name.removeprefix(READER)).words for c in readers]
    return " \\\n  ".join(map(shlex.join, words))


def as_text(value: Plain) -> str:
    """A value as it stands on a command line, without the name of anyone's home."""
    return without_home(str(value))
