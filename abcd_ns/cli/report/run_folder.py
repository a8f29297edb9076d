"""A run's folder, read without trusting it: JSON, tensors, and no Python objects."""

import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.cli.report.story import Story, read_story
from abcd_ns.data.input_errors import one_line
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore, StoreError
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.errors import UserError, first_line
from abcd_ns.lab.results.records import read_record
from abcd_ns.lab.runs.configs import REGISTERED
from abcd_ns.lab.runs.options import set_options
from abcd_ns.nerfstudio.datamanager import READERS
from abcd_ns.nerfstudio.pipeline import AbcdPipeline, AbcdPipelineConfig
from abcd_ns.nerfstudio.run.run_log import LOG_FILE
from abcd_ns.nerfstudio.run.settings import SCHEMA, Settings
from abcd_ns.nerfstudio.trainer import AbcdTrainerConfig
from abcd_ns.nerfstudio.views import views_of
from abcd_ns.run import SETTINGS_FILE, STATE, STORE
from abcd_ns.run.store import MADE_FOR, MadeFor

CHECKPOINTS = "nerfstudio_models"
_DAMAGE = (OSError, EOFError, RuntimeError, ValueError, KeyError, TypeError, UnpicklingError)
"""What comes of reading a file that is no checkpoint of ours."""


@dataclass(frozen=True)
class Checkpoint:
    """The newest that a run saved."""

    path: Path
    step: int  # optimisation steps taken
    pipeline: dict[str, Any]  # the pipeline's state_dict
    tree: BlockTree

    @property
    def means(self) -> Float[Tensor, "n 3"]:
        """Of all Gaussians, world units."""
        return self.pipeline["_model.gauss_params.means"]


@dataclass(frozen=True)
class RunFolder:
    """What a run left."""

    path: Path
    settings: Settings
    story: Story
    checkpoint: Checkpoint | None  # None where the run ended before its first
    state: RunState = field(default_factory=RunState)
    """Of the planner at the checkpoint, or else the last that was saved."""
    photos: str | None = None  # of MadeFor; None where that is not known


def open_run(path: Path) -> RunFolder:
    """Read a run's settings, log, newest checkpoint and state; UserError where one cannot be read."""
    settings = read_record(path / STATE / SETTINGS_FILE, Settings, SCHEMA)
    story = read_story(path / STATE / LOG_FILE)
    checkpoint = _newest(path / CHECKPOINTS)
    if checkpoint is not None:  # the log does not tell of a block that was cut off and not yet visited
        story = replace(story, blocks=max(story.blocks, checkpoint.tree.num_blocks))
    return RunFolder(path, settings, story, checkpoint, *_read_state(path / STATE / STORE, checkpoint))


def load_pipeline(run: RunFolder, data: Path) -> AbcdPipeline:
    """The trained model of the checkpoint with its data, for drawing. A UserError where `pipeline_config`
    raises one, the data is gone or another run's, or the checkpoint does not fit this version."""
    config, checkpoint = pipeline_config(run.path, data), run.checkpoint
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    pipeline = config.setup(device=device, test_mode="test").eval()
    trained_on = pipeline.datamanager.train_dataset
    here = MadeFor.of(trained_on.image_filenames, views_of(trained_on.cameras), config.training)
    if run.photos not in (None, here.photos):
        raise UserError(f"The photos of {data} are not those that {run.path} was trained on; give its own.")
    try:
        pipeline.load_pipeline(checkpoint.pipeline, checkpoint.step - 1)
    except (KeyError, RuntimeError) as error:
        why, where = " ".join(str(error).split()), _settings_file(run.path, run.settings)
        raise UserError(one_line(f"{checkpoint.path} does not fit the options in {where}: {why}.")) from None
    return pipeline


def pipeline_config(run: Path, data: Path) -> AbcdPipelineConfig:
    """The options that a run was trained with, for the photos in `data`: their folder, or its
    transforms.json. The path in the run is not followed: a run from elsewhere could name anything. A
    UserError if an option leads out of `data`, or is none of this version."""
    settings, prefix = read_record(run / STATE / SETTINGS_FILE, Settings, SCHEMA), "pipeline."
    where = _settings_file(run, settings)
    options = {n.removeprefix(prefix): v for n, v in settings.options.items() if n.startswith(prefix)}
    config = registered_config(settings).pipeline
    set_options(config, options, where)
    folder = (data if data.is_dir() else data.parent).resolve()
    for name, value in options.items():  # photos, masks and points are those of `data`
        of_data = name.startswith("datamanager.") and not name.endswith(".data")
        if not of_data or not isinstance(value, str):
            continue
        if "\0" in value or not (folder / value).resolve().is_relative_to(folder):
            what = one_line(f"pipeline.{name} is {value}")
            raise UserError(f"{where}: {what}, outside of {folder}; nothing there is read.")
    config.datamanager.data = data
    return config


def _settings_file(run: Path, settings: Settings) -> str:
    """In words, fit for a terminal."""
    versions = settings.versions
    wrote = f"abcd_ns {versions.abcd_ns}" + (f", commit {versions.commit}" if versions.commit else "")
    return one_line(f"{run / STATE / SETTINGS_FILE} (written by {wrote})")


def registered_config(settings: Settings) -> AbcdTrainerConfig:
    """The run's method and reader of data as this version has them; UserError where it has not."""
    found = copy.deepcopy(REGISTERED.get(settings.method))
    if found is None:
        raise UserError(f"The run's method {settings.method!r} is none of this version of abcd_ns.")
    if settings.reader not in READERS:
        raise UserError(f"The run's data was read by {settings.reader!r}, which nerfstudio does not know.")
    found.pipeline.datamanager.dataparser = copy.deepcopy(READERS[settings.reader])
    return found


def _newest(folder: Path) -> Checkpoint | None:
    path = max(folder.glob("step-*.ckpt"), default=None)
    if path is None:
        return None
    try:
        # Tensors and plain values only: an unpickler that made objects would run what the file says.
        content = torch.load(path, map_location="cpu", weights_only=True)
        tree = BlockTree.from_json(content["pipeline"]["_model._extra_state"]["tree"])
        return Checkpoint(path, int(content["step"]) + 1, content["pipeline"], tree)
    except _DAMAGE as error:
        why = f"{path} cannot be read ({first_line(error)}); remove it to use an earlier one."
        raise UserError(one_line(why)) from None


def _read_state(folder: Path, checkpoint: Checkpoint | None) -> tuple[RunState, str | None]:
    if not folder.is_dir():
        return RunState(), None
    try:
        store = ParameterStore.open(folder, read_only=True)
        if checkpoint is not None and checkpoint.path.stem in store.pins:
            store = ParameterStore.open(folder, checkpoint.path.stem)
        return RunState.from_json(store.state), store.header.get(MADE_FOR, {}).get("photos")
    except StoreError as error:
        raise UserError(one_line(str(error))) from None
