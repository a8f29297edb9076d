"""`abcd stability`: make methods fail, and see what ABCD does."""

import shlex
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as TimeLeft

from abcd_ns.errors import UserError
from abcd_ns.lab.results.findings import findings_of, headline
from abcd_ns.lab.results.results import Curve, Outcome
from abcd_ns.lab.runs.checks import Flag, Number, check_ranges, words
from abcd_ns.lab.runs.experiment import new_results, print_paths, write_report
from abcd_ns.lab.runs.runner import claim
from abcd_ns.lab.stability.charts import draw_curves
from abcd_ns.lab.stability.curves import Study, studies
from abcd_ns.lab.stability.lab import Lab
from abcd_ns.lab.stability.outcome import Scenario
from abcd_ns.lab.stability.scenarios import blocks, cameras, captures, gaussians, schedules
from abcd_ns.lab.stability.scenarios.captures import MOST_POINTS, read_stage, real_scenarios
from abcd_ns.machine import describe_machine

KIND = "stability report"
_MODULES = (gaussians, blocks, schedules, cameras, captures)
_FOUND = {one.id: one for module in _MODULES for one in vars(module).values() if isinstance(one, Scenario)}
SCENARIOS = {id: _FOUND[id] for id in sorted(_FOUND, key=lambda id: int(id[1:]))}
"""By id, A1 to A22."""


def stability(
    *,
    out: Path,
    data: Annotated[Path | None, words("DIR")] = None,
    downscale: Number = 1,
    only: Annotated[tuple[str, ...], words("A1 A3 ...")] = (),
    quick: Flag = False,
    seed: Number = 0,
    overwrite: Flag = False,
) -> int:
    """Make small scenes that make methods fail, and see what ABCD, its ablation and one block do there.

    All methods draw the same number of views. OUT gets results.json, table.md and charts of held-out PSNR
    against the number of blocks, steps a visit, the age of layers, views, noise of poses and
    exposure. Needs no GPU and no data; some 10 minutes on two cores.

    Args:
        out: Folder for the results; absent, empty, or one of an earlier call.
        data: A capture as for `ns-train abcd --data`; adds scenarios R1 to R5 on it.
        downscale: Divides the width and height of its photos.
        only: Scenarios to carry out, by id, without the charts.
        quick: A third of the training, no charts: to see that everything works. Its rules may fail.
        seed: Of every training.
        overwrite: Replace what OUT holds of other scenarios, data or seed.

    Raises:
        UserError: an option cannot be used, or OUT holds something else.
    """
    check_ranges({"downscale": downscale})
    check_ranges({"seed": seed}, low=0)
    scene = None if data is None else data.resolve().name
    names = sorted({name.upper() for name in only})
    asked = {"only": names, "quick": quick, "seed": seed, "data": scene, "downscale": downscale}
    console, known = Console(), dict(SCENARIOS)
    if data is not None:
        stage = read_stage(data, downscale, MOST_POINTS)
        known |= {scenario.id: scenario for scenario in real_scenarios(stage, data.resolve().name)}
    chosen = choose(names, known)
    claim(out, KIND, {"scenarios": asked}, overwrite)  # only now: what is refused takes no folder
    wanted = () if only or quick else studies()
    blank, paths = new_results(KIND, _command(asked, out), describe_machine()), []

    def keep(outcomes: Sequence[Outcome], curves: Sequence[Curve]) -> None:
        results = replace(blank, outcomes=tuple(outcomes), curves=tuple(curves))
        results = replace(results, findings=findings_of(results))
        paths[:] = write_report(results, out, draw_curves)

    with tempfile.TemporaryDirectory(prefix="abcd-stability-") as folder, _bar(console) as progress:
        lab = Lab(Path(folder), quick=quick, seed=seed)
        outcomes = carry_out(lab, chosen, wanted, progress, keep)
    print_paths(paths, console)
    console.print(headline(outcomes), highlight=False, soft_wrap=True)
    return 0 if all(outcome.passed for outcome in outcomes) else 1


def _command(asked: Mapping[str, Any], out: Path) -> str:
    """The command line that makes the same, with the names of folders instead of where they are."""
    line = ["abcd", "stability", *(["--only", *asked["only"]] if asked["only"] else [])]
    line += ["--data", asked["data"], "--downscale", asked["downscale"]] if asked["data"] else []
    line += [*(["--quick"] if asked["quick"] else []), "--seed", asked["seed"], "--out", out.resolve().name]
    return shlex.join(map(str, line))


def choose(only: Sequence[str], known: dict[str, Scenario]) -> list[Scenario]:
    """The scenarios asked for, in their order; all if none is named.

    Raises:
        UserError: there is none of that id.
    """
    for name in sorted(set(only) - set(known)):
        hint = "; R1 to R5 need --data" if name.startswith("R") else ""
        raise UserError(f"--only {name}: there is no such scenario{hint}; there are {', '.join(known)}.")
    return [scenario for name, scenario in known.items() if not only or name in only]


def carry_out(
    lab: Lab,
    scenarios: Sequence[Scenario],
    wanted: Sequence[Study],
    progress: Progress,
    keep: Callable[[Sequence[Outcome], Sequence[Curve]], None],
) -> list[Outcome]:
    """Every scenario and every curve, one after the other.

    Args:
        keep: given all that is there after each of them, so that a call that is broken off leaves something.
    """
    outcomes: list[Outcome] = []
    curves: list[Curve] = []
    total = sum(scenario.cost for scenario in scenarios) + sum(map(len, wanted))
    task, taken = progress.add_task("", total=total, steps=0), count(1)
    lab.tick = lambda: progress.update(task, steps=next(taken))
    for scenario in scenarios:
        progress.update(task, description=f"{scenario.id} {scenario.fails}"[:44])
        outcomes.append(examine(lab, scenario))
        progress.advance(task, scenario.cost)
        print_outcome(outcomes[-1], progress.console)
        keep(outcomes, curves)
    for study in wanted:
        progress.update(task, description=f"chart: {study.title}"[:44])
        curves.append(study.make(lab, partial(progress.advance, task)))
        progress.console.print(f"      chart: {study.title}", highlight=False)
        keep(outcomes, curves)
    return outcomes


def examine(lab: Lab, scenario: Scenario) -> Outcome:
    """Carry out one scenario."""
    torch.manual_seed(0)
    began = time.perf_counter()
    found = scenario.run(lab)
    seconds = round(time.perf_counter() - began, 1)
    asked = (scenario.id, scenario.fails, scenario.done, scenario.rule)
    numbers = {name: float(value) for name, value in found.numbers.items()}
    return Outcome(*asked, found.passed, found.worse, found.said, numbers, seconds)


def print_outcome(outcome: Outcome, console: Console) -> None:
    """A scenario's lines in the terminal."""
    word = "pass" if outcome.passed else "FAIL"
    head = f"{outcome.id:>4}  {word}  {outcome.fails}  ({outcome.seconds:.0f} s)"
    console.print(head, highlight=False, soft_wrap=True)
    for method, said in outcome.said.items():
        console.print(
            f"            {method}: {said}", highlight=False, markup=False, emoji=False, soft_wrap=True
        )


def _bar(console: Console) -> Progress:
    what, steps = TextColumn("{task.description}"), TextColumn("{task.fields[steps]:,} steps")
    columns = (what, BarColumn(20), TaskProgressColumn(), steps, TimeElapsedColumn(), TimeLeft())
    return Progress(*columns, console=console)
