"""What --load-dir, --load-step and --load-checkpoint resume."""

from pathlib import Path

from nerfstudio.engine.trainer import TrainerConfig

from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore, StoreError
from abcd_ns.engine.store.manifest import manifest_path, pin_names
from abcd_ns.errors import UserError
from abcd_ns.run import STATE, STORE
from abcd_ns.run.store import ASKED, Start


def find_start(config: TrainerConfig) -> Start | None:
    """What --load-dir, --load-step and --load-checkpoint name, or a UserError; None begins anew.

    `--load-dir` alone takes the newest state of the run. It names its folder or `nerfstudio_models` in it.
    """
    if config.load_checkpoint is not None:
        if config.load_dir is not None or config.load_step is not None:
            raise UserError("--load-checkpoint says it all: leave out --load-dir and --load-step.")
        return _at_checkpoint(config.load_checkpoint)
    if config.load_dir is None:
        if config.load_step is not None:
            raise UserError(f"--load-step {config.load_step} does not say of which run: add --load-dir.")
        return None
    within = any((config.load_dir / name).is_dir() for name in (STATE, config.relative_model_dir))
    run = config.load_dir if within else config.load_dir.absolute().parent
    if config.load_step is not None:
        return _at_checkpoint(run / config.relative_model_dir / f"{pin_name(config.load_step)}.ckpt")
    store = run / STATE / STORE
    if not store.is_dir():
        if any((run / config.relative_model_dir).glob("step-*.ckpt")):
            raise _view_only(run, f"the folder {store} is missing")
        raise UserError(f"There is no run of ABCD in {config.load_dir}: give outputs/SCENE/METHOD/TIME.")
    return _at(store, None)


def pin_name(step: int) -> str:
    """The store's pin of a checkpoint: its file name without the ending."""
    return f"step-{step:09d}"


def check_start(start: Start | None, folder: Path, asked: int) -> None:
    """Raise a UserError if the store in `folder` is another run's or in use, or if the resumed run has other
    than `asked` blocks, where that is not 0."""
    if manifest_path(folder).exists():
        if start is None or not folder.samefile(start.store):
            run = folder.parent.parent
            raise UserError(f"{folder} holds a run already: add --load-dir {run}, or another --timestamp.")
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
    """Whether the store in `folder` holds anything, so that its run can be resumed."""
    try:
        return bool(ParameterStore.open(folder, read_only=True).blocks)
    except StoreError:
        return False


def _view_only(path: Path, why: str) -> UserError:
    return UserError(f"{path} can be viewed but not trained further: {why}; begin a new run.")


def _at_checkpoint(path: Path) -> Start:
    if not path.exists():
        raise UserError(f"There is no checkpoint {path}: give a step-*.ckpt of a run's nerfstudio_models.")
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
