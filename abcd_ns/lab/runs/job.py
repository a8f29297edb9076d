"""What a worker process is told to do: a method, a seed, and what all runs of a folder share."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, get_args

Method = Literal[
    "abcd-monolithic", "abcd", "abcd-ablated", "abcd-partition", "abcd-exact", "abcd-paper", "splatfacto"
]
METHODS: tuple[str, ...] = get_args(Method)
"""In the order in which tables and charts show them."""
HELD_OUT_EVERY = 8
"""Views 0, 8, 16, ... of the list sorted by name are never trained on, as in the papers of the field."""


@dataclass(frozen=True)
class Settings:
    """What all runs of a folder share; runs that differ in any of these are not comparable."""

    data: str
    """The scene, as an absolute path."""
    downscale: int
    blocks: int
    seconds: float | None
    """Of training; None where the budget is in steps."""
    steps: int | None
    evals: int
    """Points of the curve of held-out PSNR over training time, the end included."""
    max_gaussians: int
    """In the whole scene; 0 means no limit."""
    densify: bool
    pictures: int
    """Held-out views that are shown."""

    @property
    def scene(self) -> str:
        """The name of the scene: its folder's."""
        path = Path(self.data)
        return path.parent.name if path.suffix == ".json" else path.name

    @property
    def moments(self) -> tuple[float, ...]:
        """Shares of the run, up to 1, at which held-out views are drawn; denser where quality rises fast."""
        return tuple((k / self.evals) ** 2 for k in range(1, self.evals + 1))


@dataclass(frozen=True)
class Change:
    """One option of a method, set to something else than its default."""

    path: str
    """Under the pipeline's configuration, dotted: `training.warmup`."""
    value: str
    """As it would stand on the command line."""

    def __str__(self) -> str:
        return f"{self.path}={self.value}"


@dataclass(frozen=True)
class Variant:
    """A method with some of its options changed."""

    changes: tuple[Change, ...] = ()

    @property
    def name(self) -> str:
        """What is changed: `training.warmup=0.1`."""
        return " ".join(map(str, self.changes)) or "default"

    @property
    def folder(self) -> str:
        """The name as a part of a path; "" for the method as it is."""
        return re.sub(r"[^\w.=+-]+", "_", self.name) if self.changes else ""


AS_IT_IS = Variant()
"""The method with its own defaults."""


@dataclass(frozen=True)
class Job:
    """One run: what a worker process is given."""

    method: str
    seed: int
    settings: Settings
    variant: Variant = AS_IT_IS

    @property
    def name(self) -> str:
        """For messages."""
        changes = [self.variant.name] if self.variant.changes else []
        return ", ".join([self.method, *changes, f"seed {self.seed}"])

    def folder(self, out: Path) -> Path:
        """Where the run is kept; nerfstudio's layout of output_dir/experiment/method/timestamp."""
        parts = [self.variant.folder] if self.variant.changes else []
        return out / "runs" / self.method / "-".join([*parts, f"seed-{self.seed}"])


class Plan(Protocol):
    """The runs of one folder, whatever they are for."""

    @property
    def kind(self) -> str:
        """What the folder holds, in a word or a few: "comparison"."""

    @property
    def settings(self) -> Settings:
        """What all runs share."""

    @property
    def out(self) -> Path:
        """The folder."""

    @property
    def jobs(self) -> tuple[Job, ...]:
        """All runs, in the order in which they are made."""


def evenly(count: int, wanted: int) -> tuple[int, ...]:
    """`wanted` of the rows 0 .. count - 1, as far apart from each other as from both ends."""
    wanted = min(count, wanted)
    return tuple(int((k + 0.5) * count / wanted) for k in range(wanted))
