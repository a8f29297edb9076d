"""What a worker process is told to do: a method, a seed, and what all runs of a folder share."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

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
    """0 where each arm has its own."""
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
    def budget(self) -> str:
        """Of a run, in words."""
        return f"{self.steps:,} steps" if self.seconds is None else f"{self.seconds:g} s"

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
    def number(self) -> int | None:
        """What is set, where that is one whole number."""
        values = [change.value for change in self.changes]
        return int(values[0]) if len(values) == 1 and values[0].isdecimal() else None

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
    worker = "abcd_ns.lab.runs.worker"
    """The module that does it."""
    scratch = ()
    """Folders beside the job that are dropped when it is done."""

    @property
    def blocks(self) -> int:
        """Of a method that has any."""
        own = [int(change.value) for change in self.variant.changes if change.path == "blocks"]
        return own[0] if own else self.settings.blocks

    @property
    def name(self) -> str:
        """For messages."""
        changes = [self.variant.name] if self.variant.changes else []
        return ", ".join([self.method, *changes, f"seed {self.seed}"])

    def folder(self, out: Path) -> Path:
        """Where the run is kept; nerfstudio's layout of output_dir/experiment/method/timestamp."""
        parts = [self.variant.folder] if self.variant.changes else []
        return out / "runs" / self.method / "-".join([*parts, f"seed-{self.seed}"])


@dataclass(frozen=True)
class TerrainSettings:
    """What all runs on a synthetic terrain share."""

    gaussians: int
    """In each tile."""
    visits: int
    """Budget of a run; in one block none."""
    ram_budget_bytes: int = 16 << 20
    """For blocks that were read, smaller than any scene; layers and photos have their own."""
    device_limit_bytes: int = 0
    """GPU memory that may be taken, as if the card had no more; 0 for all of it."""


@dataclass(frozen=True)
class TerrainJob(Job):
    """A terrain to train on, by blocks or as one block; its variant says of how many tiles."""

    settings: TerrainSettings
    worker = "abcd_ns.lab.runs.terrain"
    scratch = ("store", "layers")  # gigabytes; what they took is in the run

    @property
    def tiles(self) -> int:
        """A power of 2."""
        return self.variant.number


@dataclass(frozen=True)
class Plan:
    """All runs of an experiment."""

    kind: str
    """What the folder holds, in a few words; another kind needs another folder."""
    settings: Any
    """What all runs share: a frozen dataclass of JSON's scalars."""
    out: Path
    jobs: tuple[Job, ...]
    """In the order in which they are made: seed by seed, so that one that is interrupted has every arm's
    first seed first."""
    command: str
    """The command line that makes the same."""

    @property
    def methods(self) -> tuple[str, ...]:
        """In their order."""
        return tuple(dict.fromkeys(job.method for job in self.jobs))

    @property
    def seeds(self) -> tuple[int, ...]:
        """In their order."""
        return tuple(dict.fromkeys(job.seed for job in self.jobs))
