"""The store of a run: a new one, or one that an earlier run has left."""

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from abcd_ns.engine.render import PrimitiveName
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.train.capture.light import Kind as LightKind
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.types import View
from abcd_ns.errors import UserError

MADE_FOR = "made for"
ASKED, MEMORY = "blocks asked for", "memory asked for"
"""Entries of a store's header: what can resume it, `--pipeline.blocks` of the run that began it, and the
`device-budget-gb` and `gaussian-bytes` that its limits follow from."""


@dataclass(frozen=True)
class Start:
    """What a run resumes from."""

    store: Path
    pin: str | None  # of a checkpoint that was asked for; None is the newest generation
    step: int  # steps that were taken until then


@dataclass(frozen=True)
class MadeFor:
    """What a store and a run that resumes from it must agree on."""

    photos: str  # digest of the training photos' names and sizes; their folder may be moved
    first_camera: list[float]  # its position, world units, to three digits
    blocks_are_trained: str
    """In turn, jointly, or each alone: what the store holds besides blocks depends on it."""
    sh_degree: int
    primitive: PrimitiveName
    antialiased: bool = False
    light: LightKind = "none"

    @staticmethod
    def of(photos: Sequence[Path], views: Sequence[View], training: TrainingConfig) -> "MadeFor":
        digest = hashlib.blake2b(digest_size=8)
        for photo, view in zip(photos, views, strict=True):
            digest.update(f"{photo.name} {view.width} {view.height}\n".encode("utf-8", "surrogateescape"))
        first_camera = [round(value, 3) for value in views[0].center.tolist()]
        recipe = training.recipe
        how = "jointly" if recipe.exact else "each alone" if recipe.overlap > 0 else "in turn"
        drawn = training.sh_degree, training.primitive, training.antialiased, training.light
        return MadeFor(digest.hexdigest(), first_camera, how, *drawn)

    def check(self, store: ParameterStore) -> None:
        """Raise a UserError that names what `store` was made for and what is here, where they differ."""
        if different := self.differences(store):
            why = f"Cannot resume {store.folder}: it was made for {different}"
            raise UserError(f"{why}. Pass its original data and options, or leave out --load-dir.")

    def differences(self, store: ParameterStore) -> str:
        """What `store` was made for that is otherwise here, in words; empty where nothing is."""
        mine = asdict(self)
        theirs = {**mine, **store.header.get(MADE_FOR, {})}  # older versions wrote down less
        different = [name for name in mine if not _agree(theirs[name], mine[name])]
        return "; ".join(f"{name.replace('_', ' ')} {theirs[name]}, not {mine[name]}" for name in different)

    def header(self) -> dict[str, Any]:
        return {MADE_FOR: asdict(self)}


def _agree(theirs: Any, mine: Any) -> bool:
    if isinstance(theirs, list) and isinstance(mine, list) and len(theirs) == len(mine):
        # Other machines and libraries may round poses otherwise in the last digits.
        return all(abs(a - b) <= 2e-3 * max(1.0, abs(b)) for a, b in zip(theirs, mine, strict=True))
    return theirs == mine


def take_over(start: Start, folder: Path, made_for: MadeFor) -> ParameterStore:
    """Make `folder` the store of a run that resumes from `start`, if it is not that store, and open it. A
    UserError if the store cannot be read or was made for something else, or `folder` cannot be written."""
    with ParameterStore.open(start.store, start.pin, read_only=True) as old:
        made_for.check(old)
        if folder.exists() and folder.samefile(start.store):
            store = ParameterStore.open(folder)
            if start.pin is not None:
                store.restore(start.pin)
            return store
        old.clone_to(folder, start.pin)
    return ParameterStore.open(folder)
