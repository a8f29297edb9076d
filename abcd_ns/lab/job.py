"""What a run is given: a method, a seed, and what all runs of a folder share."""

import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

Method = Literal[
    "abcd-monolithic",
    "abcd",
    "abcd-ablated",
    "abcd-partition",
    "abcd-exact",
    "abcd-paper",
    "splatfacto",
    "splatfacto-scaled",
]
METHODS: tuple[str, ...] = get_args(Method)  # in the order in which tables and charts show them
HELD_OUT_EVERY = 8
"""One view in so many is never trained on: 0, 8, 16, ... of the list sorted by name, as in the papers of the
field, or a sector."""
HoldOut = Literal["auto", "interval", "sector"]
LONGEST = 200  # bytes of a folder's name; file systems take 255, and the seed follows
AS_IT_IS = "default"  # name of the variant without changes


def scene_name(path: str) -> str:
    """The name of a folder, or of that with a transforms.json."""
    found = Path(path).resolve()
    return found.parent.name if found.suffix == ".json" else found.name


@dataclass(frozen=True)
class Settings:
    """What all runs on a scene share; runs that differ in any of these are not comparable."""

    data: str  # the scene, as an absolute path
    downscale: int
    blocks: int  # 0 where each arm has its own
    seconds: float | None  # of training; None where the budget is in steps
    steps: int | None
    evals: int  # points of the curve of held-out PSNR over training time, the end included
    pictures: int  # held-out views that are shown
    hold_out: HoldOut = "auto"  # see `AbcdDataParserConfig.eval_mode`

    @property
    def scene(self) -> str:
        return scene_name(self.data)

    @property
    def budget(self) -> str:
        """Of a run, in words."""
        return f"{self.steps:,} steps" if self.seconds is None else f"{self.seconds:g} s"

    @property
    def moments(self) -> tuple[float, ...]:
        """Shares of the run, up to 1, at which held-out views are drawn; denser where quality rises fast."""
        return tuple((k / self.evals) ** 2 for k in range(1, self.evals + 1))


@dataclass(frozen=True)
class TerrainSettings:
    """What all runs on a synthetic terrain share."""

    gaussians: int  # in each tile
    visits: int  # budget of a run; in one block none
    device_limit_bytes: int = 0  # GPU memory that may be taken, as if the card had no more; 0 for all of it


@dataclass(frozen=True)
class Job:
    """One run on a scene."""

    method: str
    seed: int
    settings: Settings
    changes: tuple[str, ...] = ()
    """Options that are not the method's defaults, as `training.warmup=0`: under the pipeline's, dotted."""
    worker = "abcd_ns.lab.runs.worker"  # the module that does it
    scratch = ()  # folders beside the job that are dropped when it is done

    @property
    def variant(self) -> str:
        """What is changed, in one string."""
        return " ".join(self.changes) or AS_IT_IS

    @property
    def value(self) -> int | None:
        """What is set, where that is one whole number."""
        values = [change.partition("=")[2] for change in self.changes]
        return int(values[0]) if len(values) == 1 and values[0].isdecimal() else None

    @property
    def blocks(self) -> int:
        """Of a method that has any."""
        own = [change.partition("=")[2] for change in self.changes if change.startswith("blocks=")]
        return int(own[0]) if own else self.settings.blocks

    @property
    def name(self) -> str:
        """For messages."""
        changes = [self.variant] if self.changes else []
        return ", ".join([self.method, *changes, f"seed {self.seed}"])

    def folder(self, out: Path) -> Path:
        """Where the run is kept; nerfstudio's layout of output_dir/experiment/method/timestamp."""
        parts = [re.sub(r"[^\w.=+-]+", "_", self.variant)] if self.changes else []
        if parts and len(parts[0].encode()) > LONGEST:
            parts = [f"{parts[0][: LONGEST // 4]}-{zlib.crc32(self.variant.encode()):08x}"]
        return out / "runs" / self.method / "-".join([*parts, f"seed-{self.seed}"])


@dataclass(frozen=True)
class TerrainJob(Job):
    """One run on a terrain, by blocks or as one block; what is set is the number of tiles, a power of 2."""

    settings: TerrainSettings
    worker = "abcd_ns.lab.runs.terrain"
    scratch = ("store", "layers")  # gigabytes; what they took is in the run


@dataclass(frozen=True)
class Plan:
    """All runs of an experiment."""

    kind: str  # what the folder holds, in a few words; another kind needs another folder
    settings: Settings | TerrainSettings
    out: Path
    jobs: tuple[Job, ...]
    """In the order in which they are made: seed by seed, so that one that is interrupted has every arm's
    first seed first."""
    command: str  # the command line that makes the same
    scene: str | None = None
    """By what the data are known again; None for those of a terrain, or where nobody looked."""
