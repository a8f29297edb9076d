"""What is compared, and under which conditions: the options of `abcd compare` and what follows from them."""

import dataclasses
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from abcd_ns.errors import UserError
from abcd_ns.tools.compare.records import decode

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Method = Literal[
    "abcd-monolithic", "abcd", "abcd-ablated", "abcd-partition", "abcd-exact", "abcd-paper", "splatfacto"
]
METHODS: tuple[str, ...] = get_args(Method)
"""In the order in which tables and charts show them."""
HELD_OUT_EVERY = 8
"""Views 0, 8, 16, ... of the list sorted by name are never trained on, as in the papers of the field."""


@dataclass(frozen=True)
class Options:
    """What a user gives, on the command line or in a TOML file; None is what was not given."""

    data: str | None = None
    methods: tuple[str, ...] | None = None
    seeds: tuple[int, ...] | None = None
    downscale: int | None = None
    blocks: int | None = None
    seconds: float | None = None
    steps: int | None = None
    evals: int | None = None
    max_gaussians: int | None = None
    no_densify: bool | None = None
    pictures: int | None = None
    out: str | None = None

    def over(self, other: "Options") -> "Options":
        """These options, and `other`'s where these were not given."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        if "seconds" in given or "steps" in given:
            # A budget on the command line takes the place of the file's, whatever its unit.
            other = dataclasses.replace(other, seconds=None, steps=None)
        return dataclasses.replace(other, **given)


def read_options(path: Path) -> Options:
    """Options from a TOML file whose keys are the names of the command line's options.

    Raises:
        UserError: the file is absent, is no TOML, or has a key or value that does not fit.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"--config {path} does not exist.") from None
    except (ValueError, OSError) as error:
        raise UserError(f"--config {path} cannot be read as TOML: {error}.") from None
    return decode(Options, data, str(path))


@dataclass(frozen=True)
class Settings:
    """What all runs of a comparison share; runs that differ in any of these are not comparable."""

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
class Job:
    """One run: what a worker process is given."""

    method: str
    seed: int
    settings: Settings

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.method}, seed {self.seed}"

    def folder(self, out: Path) -> Path:
        """Where the run is kept; nerfstudio's layout of output_dir/experiment/method/timestamp."""
        return out / "runs" / self.method / f"seed-{self.seed}"


@dataclass(frozen=True)
class Plan:
    """All runs of a comparison."""

    settings: Settings
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    out: Path

    @property
    def jobs(self) -> tuple[Job, ...]:
        """Seed by seed, so that an interrupted comparison has every method's first seed first."""
        return tuple(Job(method, seed, self.settings) for seed in self.seeds for method in self.methods)

    @property
    def command(self) -> str:
        """The command line that makes this comparison."""
        s = self.settings
        budget = ["--steps", s.steps] if s.seconds is None else ["--seconds", f"{s.seconds:g}"]
        words = ["abcd", "compare", "--data", s.scene, "--methods", *self.methods, "--seeds", *self.seeds]
        words += ["--downscale", s.downscale, "--blocks", s.blocks, *budget, "--evals", s.evals]
        words += ["--max-gaussians", s.max_gaussians] if s.max_gaussians else []
        words += [] if s.densify else ["--no-densify"]
        return shlex.join(map(str, [*words, "--pictures", s.pictures, "--out", self.out.name]))


def make_plan(options: Options) -> Plan:
    """Fill in defaults and check everything that can be checked without reading the scene.

    Raises:
        UserError: an option is missing, out of range or contradicts another.
    """
    defaults = Options(
        methods=METHODS[:3], seeds=(0,), downscale=1, blocks=8, evals=8, max_gaussians=0, pictures=3
    )
    given = options.over(defaults)
    if given.data is None:
        raise UserError("Give the scene to compare on with --data FOLDER.")
    if given.out is None:
        raise UserError("Give the folder for the results with --out FOLDER.")
    if (given.seconds is None) == (given.steps is None):
        raise UserError("Give each run's budget: either --seconds or --steps.")
    if not Path(given.data).exists():
        raise UserError(f"--data {given.data} does not exist.")
    _check_ranges(given)
    _check_lists(given)
    settings = Settings(
        data=str(Path(given.data).resolve()),
        densify=not given.no_densify,
        **{
            name: getattr(given, name)
            for name in ("downscale", "blocks", "seconds", "steps", "evals", "max_gaussians", "pictures")
        },
    )
    methods = tuple(method for method in METHODS if method in given.methods)
    return Plan(settings, methods, given.seeds, Path(given.out))


def _check_ranges(given: Options) -> None:
    lowest = {"downscale": 1, "blocks": 1, "steps": 1, "evals": 1, "max_gaussians": 0, "pictures": 0}
    for name, low in lowest.items():
        value = getattr(given, name)
        if value is not None and value < low:
            raise UserError(f"--{name.replace('_', '-')} is {value}; it must be at least {low}.")
    if given.seconds is not None and not 0 < given.seconds < float("inf"):
        raise UserError(f"--seconds is {given.seconds}; it must be above 0.")


def _check_lists(given: Options) -> None:
    for method in given.methods:
        if method not in METHODS:
            raise UserError(f"There is no method {method!r} to compare; there are {', '.join(METHODS)}.")
    if "abcd-paper" in given.methods and given.steps is None:
        raise UserError(
            "abcd-paper gives each cell a fixed number of steps: use --steps instead of --seconds."
        )
    if not given.methods or not given.seeds:
        raise UserError("Give at least one of --methods and one of --seeds.")
    if len(set(given.seeds)) < len(given.seeds) or min(given.seeds) < 0:
        raise UserError(f"--seeds {' '.join(map(str, given.seeds))}: give different numbers from 0 up.")
