"""How a run goes on from another, and what both keep on disk beside nerfstudio's files."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nerfstudio.engine.trainer import TrainerConfig

from abcd_ns.engine.render import PrimitiveName
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore, StoreError
from abcd_ns.engine.store.manifest import manifest_path, pin_names
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.types import View
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.run import STATE, STORE
from abcd_ns.nerfstudio.run.settings import Plain

MADE_FOR = "made for"
"""The entry of a store's header that tells what it can be trained on with."""
ASKED = "blocks asked for"
"""The entry of a store's header that has `--pipeline.blocks` as it was when the run began."""


@dataclass(frozen=True)
class Start:
    """What a run goes on from."""

    store: Path
    pin: str | None
    """The pin of a checkpoint that was asked for; None is the newest generation."""
    step: int
    """Steps that were taken until then."""


@dataclass(frozen=True)
class RunRequest:
    """A training, as its trainer begins it."""

    config: TrainerConfig
    folder: Path
    """For all that is ours: STATE in the run's folder."""
    total_steps: int
    """Of the whole run, those before a resume included."""
    options: dict[str, Plain]
    """As it was asked for, by dotted name: `config` has what follows from them, too."""
    resumed_from: Start | None
    """What it goes on from; None begins anew."""


@dataclass(frozen=True)
class MadeFor:
    """What a store and whoever goes on with it must agree on."""

    photos: str
    """Digest of the training photos' names and sizes. Not of their folder: it may be moved."""
    first_camera: list[float]
    """Its position, world units, to three digits."""
    blocks_are_trained: str
    """In turn, jointly, or each alone: what the store holds besides blocks depends on it."""
    sh_degree: int
    primitive: PrimitiveName

    @staticmethod
    def of(photos: Sequence[Path], views: Sequence[View], training: TrainingConfig) -> "MadeFor":
        """Of a run on these photos, taken by these cameras."""
        digest = hashlib.blake2b(digest_size=8)
        for photo, view in zip(photos, views, strict=True):
            digest.update(f"{photo.name} {view.width} {view.height}\n".encode("utf-8", "surrogateescape"))
        first_camera = [round(value, 3) for value in views[0].center.tolist()]
        recipe = training.recipe
        how = "jointly" if recipe.exact else "each alone" if recipe.overlap > 0 else "in turn"
        return MadeFor(digest.hexdigest(), first_camera, how, training.sh_degree, training.primitive)

    def check(self, store: ParameterStore) -> None:
        """See that `store` was made for the same.

        Raises:
            UserError: it was not; both are shown.
        """
        different = self.differences(store)
        if different:
            why = f"Cannot resume {store.folder}: it was made for {different}"
            raise UserError(f"{why}. Pass its original data and options, or leave out --load-dir.")

    def differences(self, store: ParameterStore) -> str:
        """What `store` was made for that is otherwise here, in words; empty where nothing is."""
        theirs, mine = store.header.get(MADE_FOR), asdict(self)
        if theirs is None:  # made before this was written down
            return ""
        theirs = {"primitive": "3dgs"} | theirs  # nothing else there was
        different = [name for name in mine if not _agree(theirs.get(name), mine[name])]
        return "; ".join(
            f"{name.replace('_', ' ')} {theirs.get(name)}, not {mine[name]}" for name in different
        )

    def header(self) -> dict[str, Any]:
        """The entry of a new store's header."""
        return {MADE_FOR: asdict(self)}


def _agree(theirs: Any, mine: Any) -> bool:
    if isinstance(theirs, list) and isinstance(mine, list) and len(theirs) == len(mine):
        # Other machines and libraries may round poses otherwise in the last digits.
        return all(abs(a - b) <= 2e-3 * max(1.0, abs(b)) for a, b in zip(theirs, mine, strict=True))
    return theirs == mine


def find_start(config: TrainerConfig) -> Start | None:
    """What --load-dir, --load-step and --load-checkpoint ask for; None begins anew.

    `--load-dir` alone is the newest that the run has: its last visit's end, or its last checkpoint where that
    is newer. It may name the run's folder or `nerfstudio_models` in it, with or without checkpoints there.

    Raises:
        UserError: there is nothing to go on from, or the options name two things.
    """
    if config.load_checkpoint is not None:
        if config.load_dir is not None or config.load_step is not None:
            raise UserError("--load-checkpoint says it all: leave out --load-dir and --load-step.")
        return _at_checkpoint(config.load_checkpoint)
    if config.load_dir is None:
        if config.load_step is not None:
            raise UserError(f"--load-step {config.load_step} does not say of which run: add --load-dir.")
        return None
    within = (config.load_dir / STATE).is_dir()
    run = config.load_dir if within else config.load_dir.absolute().parent
    if config.load_step is not None:
        return _at_checkpoint(run / config.relative_model_dir / f"{pin_name(config.load_step)}.ckpt")
    store = run / STATE / STORE
    if not store.is_dir():
        if any((run / config.relative_model_dir).glob("step-*.ckpt")):
            raise _view_only(run, f"the folder {store} is missing")
        raise UserError(f"There is no run of ABCD in {config.load_dir}: it has no {store}.")
    return _at(store, None)


def pin_name(step: int) -> str:
    """The store's pin that belongs to a checkpoint: its file name without the ending."""
    return f"step-{step:09d}"


def check_start(start: Start | None, folder: Path, asked: int) -> None:
    """Check what a run resumes from before it writes anything.

    Args:
        folder: for its store.
        asked: `--pipeline.blocks`; 0 accepts any number.

    Raises:
        UserError: `folder` holds another run's store or is being written to; or the run resumed from was
            begun with another number of blocks.
    """
    if manifest_path(folder).exists():
        if start is None or not folder.samefile(start.store):
            raise _is_taken(folder)
        ParameterStore.open(folder).close()
    if start is None or asked == 0:
        return
    with ParameterStore.open(start.store, start.pin, read_only=True) as store:
        before = store.header.get(ASKED, asked)  # older runs did not write it down
        there = BlockTree.from_json(store.header["tree"]).num_blocks
    if asked not in (before, there):
        begun = f"The run in {start.store} was begun with --pipeline.blocks {before}, not {asked}"
        raise UserError(f"{begun}: give that number, or leave out --load-dir.")


def has_begun(folder: Path) -> bool:
    """Whether a run has put anything into its store in `folder`, so that it can be gone on with."""
    try:
        return bool(ParameterStore.open(folder, read_only=True).blocks)
    except StoreError:
        return False


def _is_taken(folder: Path) -> UserError:
    run = folder.parent.parent
    return UserError(f"{folder} holds a run already: add --load-dir {run}, or another --timestamp.")


def take_over(start: Start, folder: Path, made_for: MadeFor) -> ParameterStore:
    """Make `folder` the store of a run that goes on from `start`, and open it.

    Where `folder` is the very store that the run goes on from, it is simply opened.

    Raises:
        UserError: the store cannot be read, or was made for something else; the disk refused; or another run
            is writing to `folder`.
    """
    with ParameterStore.open(start.store, start.pin, read_only=True) as old:
        made_for.check(old)
        if folder.exists() and folder.samefile(start.store):
            store = ParameterStore.open(folder)
            if start.pin is not None:
                store.restore(start.pin)
            return store
        old.clone_to(folder, start.pin)
    return ParameterStore.open(folder)


def new_store(folder: Path, header: dict[str, Any]) -> ParameterStore:
    """An empty store for a run that begins.

    Raises:
        UserError: `folder` holds the store of another run, or the disk refused.
    """
    try:
        return ParameterStore.create(folder, header)
    except StoreError as error:
        if not manifest_path(folder).exists():
            raise
        raise _is_taken(folder) from error


def _view_only(path: Path, why: str) -> UserError:
    return UserError(f"{path} can be viewed but not trained further: {why}.")


def _at_checkpoint(path: Path) -> Start:
    if not path.exists():
        raise UserError(f"There is no checkpoint {path}.")
    store = path.absolute().parent.parent / STATE / STORE
    if not store.is_dir():
        raise _view_only(path, f"the folder {store} is missing")
    if path.stem not in pin_names(store):
        raise _view_only(path, f"{store} has no such moment")
    return _at(store, path.stem)


def _at(folder: Path, pin: str | None) -> Start:
    with ParameterStore.open(folder, pin, read_only=True) as store:
        if not store.blocks:
            raise UserError(f"The run in {folder} ended before it began: start it anew, without --load-dir.")
        return Start(folder, pin, store.state.get("step", 0))
