"""`abcd study`: vary one thing and see what it does."""

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.job import AS_IT_IS, Change, Job, Plan, Variant
from abcd_ns.lab.runs import experiment
from abcd_ns.lab.runs.checks import Flag, Number, Numbers, check_numbers, make_settings, words
from abcd_ns.lab.study.charts import draw_study

AbcdMethod = Literal["abcd", "abcd-ablated", "abcd-monolithic", "abcd-partition", "abcd-exact"]
BLOCKS, LIMIT = "blocks", "training.density.max_gaussians"
PRICE, STRATEGY = "training.density.price", "training.density.strategy"
"""The options that the first two studies vary."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """What every study takes."""

    data: Annotated[Path, tyro.conf.arg(metavar="PATH")]
    """The scene: a folder with a COLMAP model or transforms.json, as for `ns-train abcd --data`."""
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")]
    """Folder for the results; absent, empty, or one of an earlier study of the same kind."""
    seconds: Annotated[float | None, words("S")] = None
    """Budget of a run: seconds of training; evaluation, saving and compiling do not count."""
    steps: Annotated[int | None, words("N")] = None
    """Budget of a run: optimisation steps. Give either this or --seconds."""
    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...", aliases=("--seed",))] = (0,)
    """Each run once for each. Several tell what is an effect and what is chance."""
    downscale: Number = 1
    """Divides the photos' width and height."""
    evals: Number = 4
    """Times that held-out views are scored during a run, the end included."""
    overwrite: Flag = False
    """Drop the runs that OUT holds."""

    def _planned(
        self,
        study: str,
        method: str,
        variants: Sequence[Variant],
        varied: Sequence[Any],
        *,
        blocks: int = 8,
        max_gaussians: int = 0,
        notes: Sequence[str] = (),
    ) -> Plan:
        """All runs, every option and the scene looked at; `varied` is what the command line says of them."""
        # Here and not above: nerfstudio takes seconds to import, and `--help` has no use for it.
        from abcd_ns.lab.runs.configs import check_options, check_scene

        names = ("data", "out", "seeds", "seconds", "steps", "downscale", "evals")
        given = {name: getattr(self, name) for name in names}
        given |= {"blocks": blocks, "max_gaussians": max_gaussians, "densify": True, "pictures": 0}
        settings = make_settings(**given)
        jobs = tuple(Job(method, seed, settings, v) for seed in self.seeds for v in variants)
        line = ["abcd", "study", study, "--data", settings.scene, "--method", method, *varied]
        line += [*settings.words(study != "blocks"), "--seeds", *self.seeds, "--out", self.out.name]
        for job in jobs:
            check_options(job)
        check_scene(jobs[0])
        command = shlex.join(map(str, line))
        return Plan(f"study of {study}", settings, self.out, jobs, command, tuple(notes))


@dataclass(frozen=True, kw_only=True)
class BlocksStudy(Conditions):
    """Held-out quality, time and memory against the number of blocks. The goal: no cliff, the worst number
    within 0.5 dB of the best."""

    blocks: Numbers = (1, 2, 4, 8, 16, 27)
    """Numbers of blocks to try."""
    method: AbcdMethod = "abcd"
    """What is trained."""
    max_gaussians: Number = 0
    """In the whole scene, so that no number of blocks wins by having more; 0 for no limit."""

    def plan(self) -> Plan:
        """All runs, checked.

        Raises:
            UserError: an option cannot be used.
        """
        check_numbers("--blocks", self.blocks, 1, several=True)
        numbers = sorted(self.blocks)
        variants = [_one(BLOCKS, number) for number in numbers]
        varied = ["--blocks", *numbers]
        return self._planned("blocks", self.method, variants, varied, max_gaussians=self.max_gaussians)


@dataclass(frozen=True, kw_only=True)
class GaussiansStudy(Conditions):
    """How few Gaussians a scene needs: held-out quality against their number. The method as it is, which
    finds its number by itself, is marked on the curve of other prices for a Gaussian; beside it growth that
    is cut off at a limit, and 3DGS-MCMC's relocation up to a limit."""

    prices: Annotated[tuple[float, ...], tyro.conf.arg(metavar="PIXELS ...")] = (0.0, 1.0, 4.0, 16.0, 64.0)
    """What a Gaussian must fill to stay, see training.density.price."""
    max_gaussians: Numbers = (2000, 8000, 32000)
    """Limits for the whole scene; below the number of initial points a random choice of them begins."""
    method: AbcdMethod = "abcd"
    """What is trained."""
    blocks: Number = 8
    """Blocks of all but abcd-monolithic."""

    def plan(self) -> Plan:
        """All runs, checked.

        Raises:
            UserError: an option cannot be used.
        """
        if self.max_gaussians:
            check_numbers("--max-gaussians", self.max_gaussians, 1, several=True)
        for price in self.prices:
            if not 0 <= price < math.inf:
                raise UserError(f"--prices {price:g}: a price is 0 or more, in pixels.")
        prices, limits = [f"{price:g}" for price in sorted(self.prices)], sorted(self.max_gaussians)
        if len(set(prices)) < len(prices):
            raise UserError(f"--prices {' '.join(prices)}: give different prices.")
        varied = ["--prices", *prices, "--max-gaussians", *limits]
        variants = [AS_IT_IS, *(_one(PRICE, price) for price in prices)]
        variants += [_one(LIMIT, limit) for limit in limits]
        variants += [Variant((Change(STRATEGY, "mcmc"), Change(LIMIT, str(limit)))) for limit in limits]
        return self._planned("gaussians", self.method, variants, varied, blocks=self.blocks)


@dataclass(frozen=True, kw_only=True)
class OptionsStudy(Conditions):
    """An ablation: the method as it is, and once more for each change of an option. Names are those of
    `ns-train abcd --help` under --pipeline; several options that change at
    once stand in quotes, as in --vary training.warmup=0 "partition=grid blocks=27"."""

    vary: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")]
    """Changes to try, a row for each; all are checked before the first run."""
    method: AbcdMethod = "abcd"
    """What is changed."""
    blocks: Number = 8
    """Blocks of all but abcd-monolithic, unless varied."""
    max_gaussians: Number = 0
    """In the whole scene, unless varied; 0 for no limit."""

    def plan(self) -> Plan:
        """All runs, checked.

        Raises:
            UserError: an option cannot be used, or is none of the method's.
        """
        from abcd_ns.lab.runs.configs import registered
        from abcd_ns.lab.runs.options import parse_variant, read_value

        if not self.vary:
            raise UserError("Give at least one change of an option with --vary NAME=VALUE.")
        pipeline, notes = registered(self.method).pipeline, []
        variants = [parse_variant(text, pipeline) for text in self.vary]
        asked = [{change.path: read_value(change, pipeline) for change in v.changes} for v in variants]
        shared = {LIMIT: self.max_gaussians}
        shared |= {} if self.method == "abcd-monolithic" else {BLOCKS: self.blocks}
        for variant, values in zip(variants, asked, strict=True):
            if asked.count(values) > 1:
                raise UserError(f"--vary {variant.name!r} is given twice.")
            usual = {path: shared[path] if path in shared else attrgetter(path)(pipeline) for path in values}
            if usual == values:
                shows = "its difference shows how well a run repeats itself."
                notes.append(f"{variant.name} is the default: {shows}")
        given = {"blocks": self.blocks, "max_gaussians": self.max_gaussians, "notes": notes}
        varied = ["--vary", *(variant.name for variant in variants)]
        return self._planned("options", self.method, [AS_IT_IS, *variants], varied, **given)


Study = (
    Annotated[BlocksStudy, tyro.conf.subcommand("blocks")]
    | Annotated[GaussiansStudy, tyro.conf.subcommand("gaussians")]
    | Annotated[OptionsStudy, tyro.conf.subcommand("options")]
)


@tyro.conf.configure(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes)
def study(wanted: Annotated[Study, tyro.conf.arg(name="")]) -> int:
    """Vary one thing and see what it does: the number of blocks, the number of Gaussians, or any options.

    Each run has a process of its own, one after the other, under the protocol of `abcd compare`. OUT gets
    results.json, table.md and a chart (png and svg). Called again with the same OUT, a study reuses the runs
    that are finished, so that more seeds or more values may be added later.

    abcd study blocks --data scene --seconds 60 --out blocks

    abcd study gaussians --data scene --seconds 60 --out gaussians

    abcd study options --data scene --seconds 60 --vary training.warmup=0 training.batch=1 --out options

    Args:
        wanted: which study.

    Raises:
        UserError: an option cannot be used, or OUT holds something else.
    """
    return carry_out(wanted.plan(), Console(), wanted.overwrite)


def carry_out(plan: Plan, console: Console, overwrite: bool = False) -> int:
    """Do all runs of the plan and write what came of them; exit code 1 if a run failed."""
    count, settings = len(plan.jobs), plan.settings
    text = f"{count} runs of {settings.budget}"
    if settings.seconds is not None:
        text += f": {count * settings.seconds / 60:.0f} min of training and some of start-up"
    console.print(f"{text}.", highlight=False)
    return experiment.carry_out(plan, console, draw_study, overwrite)


def _one(path: str, value: int | str) -> Variant:
    return Variant((Change(path, str(value)),))
