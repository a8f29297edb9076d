"""What a study varies, and under which conditions: everything is checked here, before anything is written."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from abcd_ns.errors import UserError
from abcd_ns.lab.runs.checks import check_budget, check_numbers, check_places, check_ranges
from abcd_ns.lab.runs.job import AS_IT_IS, METHODS, Change, Job, Settings, Variant

AbcdMethod = Literal["abcd", "abcd-ablated", "abcd-monolithic", "abcd-partition", "abcd-exact", "abcd-paper"]
Study = Literal["blocks", "gaussians", "options"]
BLOCKS, LIMIT = "blocks", "training.density.max_gaussians"
"""The options that the first two studies vary."""


@dataclass(frozen=True)
class Conditions:
    """What a user gives for any study."""

    data: Path
    out: Path
    seconds: float | None = None
    steps: int | None = None
    seeds: tuple[int, ...] = (0,)
    downscale: int = 1
    blocks: int = 8
    max_gaussians: int = 0
    evals: int = 4

    def settings(self) -> Settings:
        """What all runs share.

        Raises:
            UserError: an option is missing or out of range.
        """
        check_places(str(self.data), str(self.out))
        check_budget(self.seconds, self.steps)
        names = ("downscale", "blocks", "max_gaussians", "steps", "evals")
        check_ranges({name: getattr(self, name) for name in names})
        check_numbers("--seeds", self.seeds, 0)
        return Settings(
            data=str(self.data.resolve()),
            downscale=self.downscale,
            blocks=self.blocks,
            seconds=self.seconds,
            steps=self.steps,
            evals=self.evals,
            max_gaussians=self.max_gaussians,
            densify=True,
            pictures=0,
        )


@dataclass(frozen=True)
class StudyPlan:
    """All runs of a study: every variant of every method, with every seed."""

    study: Study
    settings: Settings
    methods: tuple[str, ...]
    variants: tuple[Variant, ...]
    seeds: tuple[int, ...]
    out: Path
    notes: tuple[str, ...] = ()
    """What a reader of the table has to know of the variants."""

    @property
    def kind(self) -> str:
        """What the folder holds; studies of different things go into different folders."""
        return f"study of {self.study}"

    @property
    def jobs(self) -> tuple[Job, ...]:
        """Seed by seed, so that an interrupted study has every variant's first seed first."""
        return tuple(
            Job(method, seed, self.settings, variant)
            for seed in self.seeds
            for method in self.methods
            for variant in self.variants
        )

    @property
    def command(self) -> str:
        """The command line that makes this study."""
        s = self.settings
        budget = ["--steps", s.steps] if s.seconds is None else ["--seconds", f"{s.seconds:g}"]
        words = ["abcd", "study", self.study, "--data", s.scene, *self._varied()]
        words += [*budget, "--seeds", *self.seeds, "--downscale", s.downscale]
        words += [] if self.study == "blocks" else ["--blocks", s.blocks]
        words += ["--max-gaussians", s.max_gaussians] if s.max_gaussians else []
        return shlex.join(map(str, [*words, "--evals", s.evals, "--out", self.out.name]))

    def _varied(self) -> list[str]:
        if self.study == "options":
            changed = [variant.name for variant in self.variants if variant.changes]
            return ["--method", *self.methods, "--vary", *changed]
        values = [variant.changes[0].value for variant in self.variants]
        if self.study == "blocks":
            return ["--method", *self.methods, "--blocks", *values]
        return ["--methods", *self.methods, "--max-gaussians", *values]


def plan_blocks(given: Conditions, method: str, blocks: tuple[int, ...]) -> StudyPlan:
    """Quality against the number of blocks.

    Raises:
        UserError: an option cannot be used.
    """
    _check_several("--blocks", blocks)
    plan = _plan("blocks", given, (method,), tuple(_one(BLOCKS, str(number)) for number in sorted(blocks)))
    return _checked(plan)


def plan_gaussians(given: Conditions, methods: tuple[str, ...], limits: tuple[int, ...]) -> StudyPlan:
    """Quality against the limit on the number of Gaussians.

    Raises:
        UserError: an option cannot be used.
    """
    _check_several("--max-gaussians", limits)
    if not methods or len(set(methods)) < len(methods):
        raise UserError("--methods: give at least one, and none twice.")
    ordered = tuple(method for method in METHODS if method in methods)
    plan = _plan("gaussians", given, ordered, tuple(_one(LIMIT, str(limit)) for limit in sorted(limits)))
    return _checked(plan)


def plan_options(given: Conditions, method: str, vary: tuple[str, ...]) -> StudyPlan:
    """The method as it is, and once more for each of `vary`.

    Raises:
        UserError: an option cannot be used, or is none of the method's.
    """
    # Here and not above: nerfstudio takes seconds to import, and `--help` has no use for it.
    from abcd_ns.lab.runs.configs import default_options
    from abcd_ns.lab.runs.options import parse_variant, read_value, value_of

    if not vary:
        raise UserError("Give at least one change of an option with --vary NAME=VALUE.")
    pipeline = default_options(method)
    variants = tuple(parse_variant(text, pipeline) for text in vary)
    folders = [variant.folder for variant in variants]
    for variant in variants:
        if folders.count(variant.folder) > 1:
            raise UserError(f"--vary {variant.name!r} is given twice.")
    shared = {BLOCKS: given.blocks, LIMIT: given.max_gaussians}
    notes = []
    for variant in variants:
        defaults = [
            shared[change.path] if change.path in shared else value_of(pipeline, change.path)
            for change in variant.changes
        ]
        if defaults == [read_value(change, pipeline) for change in variant.changes]:
            notes.append(
                f"{variant.name} is the default: its difference shows how well a run repeats itself."
            )
    return _checked(_plan("options", given, (method,), (AS_IT_IS, *variants), tuple(notes)))


def _one(path: str, value: str) -> Variant:
    return Variant((Change(path, value),))


def _check_several(option: str, numbers: tuple[int, ...]) -> None:
    check_numbers(option, numbers, 1)
    if len(numbers) < 2:
        raise UserError(f"{option} {numbers[0]}: give at least two numbers, to compare them.")


def _plan(
    study: Study,
    given: Conditions,
    methods: tuple[str, ...],
    variants: tuple[Variant, ...],
    notes: tuple[str, ...] = (),
) -> StudyPlan:
    return StudyPlan(study, given.settings(), methods, variants, given.seeds, given.out, notes)


def _checked(plan: StudyPlan) -> StudyPlan:
    from abcd_ns.lab.runs.configs import check_options, check_scene

    for job in plan.jobs:
        check_options(job)
    check_scene(plan.jobs[0])
    return plan
