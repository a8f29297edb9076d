"""What is compared, and under which conditions: the options of `abcd compare` and what follows from them."""

import dataclasses
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from abcd_ns.errors import UserError
from abcd_ns.lab.runs.checks import LOWEST, check_budget, check_numbers, check_places, check_ranges
from abcd_ns.lab.runs.job import METHODS, Job, Settings
from abcd_ns.lab.runs.records import decode

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


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
class Plan:
    """All runs of a comparison."""

    settings: Settings
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    out: Path
    kind = "comparison"

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
    check_places(given.data, given.out)
    check_budget(given.seconds, given.steps)
    check_ranges({name: getattr(given, name) for name in LOWEST})
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
    check_numbers("--seeds", given.seeds, 0)
