"""`abcd stability`: make methods fail, and see what ABCD does."""

import shlex
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
from rich.console import Console

from abcd_ns.arguments import Flag, Number, check_ranges, words
from abcd_ns.errors import UserError
from abcd_ns.lab.results.results import Outcome
from abcd_ns.lab.results.tables import findings_of, headline
from abcd_ns.lab.runs.runner import claim, new_results, write_report
from abcd_ns.lab.stability import scenarios
from abcd_ns.lab.stability.lab import Lab, Scenario
from abcd_ns.machine import describe_machine
from abcd_ns.progress_bar import ProgressBar
from abcd_ns.terminal import print_plain

KIND = "stability report"
SCENARIOS = {one.id: one for one in vars(scenarios).values() if isinstance(one, Scenario)}
"""By id; what the ids that are missing stood for are tests of the engine."""


def stability(
    *,
    out: Path,
    only: Annotated[tuple[str, ...], words("A11 A12 ...")] = (),
    seed: Number = 0,
    overwrite: Flag = False,
) -> int:
    """Make small scenes that make methods fail, and see what ABCD, its ablation and one block do there.

    All methods take the same number of steps. OUT gets results.json and table.md. Needs no GPU and no data.

    Args:
        out: Folder for the results; absent, empty, or one of an earlier call.
        only: Scenarios to carry out, by id.
        seed: Of every training.
        overwrite: Replace what OUT holds of other scenarios or seed.

    Raises:
        UserError: an option cannot be used, or OUT holds something else.
    """
    check_ranges({"seed": seed}, low=0)
    names = sorted({name.upper() for name in only})
    chosen, console, outcomes = choose(names), Console(), []
    # Only now: what is refused takes no folder.
    claim(out, KIND, {"only": names, "seed": seed}, overwrite)
    line = ["abcd", "stability", *(["--only", *names] if names else [])]
    command = shlex.join([*line, "--seed", str(seed), "--out", out.resolve().name])
    blank = new_results(KIND, command, describe_machine())
    with (
        tempfile.TemporaryDirectory(prefix="abcd-stability-") as folder,
        ProgressBar("Scenarios", len(chosen), console) as bar,
    ):
        lab = Lab(Path(folder), seed)
        for scenario in chosen:
            outcomes.append(examine(lab, scenario, console))
            bar.advance()
            results = replace(blank, outcomes=tuple(outcomes))
            paths = write_report(replace(results, findings=findings_of(results)), out)
    for text in (*paths, headline(outcomes)):
        print_plain(str(text), console)
    return 0 if all(outcome.passed for outcome in outcomes) else 1


def choose(only: Sequence[str]) -> list[Scenario]:
    """The scenarios of these ids, in their order; all if none is given. A UserError for an unknown id."""
    for name in sorted(set(only) - set(SCENARIOS)):
        raise UserError(f"--only {name}: there is no such scenario; there are {', '.join(SCENARIOS)}.")
    return [scenario for name, scenario in SCENARIOS.items() if not only or name in only]


def examine(lab: Lab, scenario: Scenario, console: Console) -> Outcome:
    """Carry out one scenario, and print what it found."""
    torch.manual_seed(0)
    began = time.perf_counter()
    found = scenario.run(lab)
    seconds = round(time.perf_counter() - began, 1)
    word = "pass" if found.passed else "FAIL"
    print_plain(f"{scenario.id:>4}  {word}  {scenario.fails}  ({seconds:.0f} s)", console)
    for method, said in found.said.items():
        print_plain(f"            {method}: {said}", console)
    asked = (scenario.id, scenario.fails, scenario.done, scenario.rule)
    numbers = {name: float(value) for name, value in found.numbers.items()}
    return Outcome(*asked, found.passed, found.worse, found.said, numbers, seconds)
