"""Tables of runs: what is measured, in which words and with how many digits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from abcd_ns.lab.runs.run import Run
from abcd_ns.nerfstudio.machine import Machine

NOTHING = "-"
"""Stands where there is no value."""
Value = Callable[[Run], float | None]


@dataclass(frozen=True)
class Measure:
    """One row."""

    title: str
    """With its unit."""
    value: Value
    digits: int


def _in(unit: int, get: Value) -> Value:
    return lambda run: None if (size := get(run)) is None else size / unit


MIB, GIB = 2**20, 2**30


MEASURES = (
    Measure("PSNR, composited (dB)", lambda run: run.psnr, 2),
    Measure("SSIM, composited", lambda run: run.ssim, 3),
    Measure("LPIPS, composited", lambda run: run.lpips, 3),
    Measure("PSNR, merged (dB)", lambda run: run.psnr_merged, 2),
    Measure("SSIM, merged", lambda run: run.ssim_merged, 3),
    Measure("ordering gap (dB)", lambda run: run.ordering_gap_db, 1),
    Measure("Gaussians", lambda run: run.gaussians, 0),
    Measure("blocks", lambda run: run.blocks, 0),
    Measure("steps", lambda run: run.steps, 0),
    Measure("training (s)", lambda run: run.train_seconds, 1),
    Measure("of it, layers (s)", lambda run: run.layer_seconds, 1),
    Measure("whole process (s)", lambda run: run.total_seconds, 1),
    Measure("peak GPU memory (GiB)", _in(GIB, lambda run: run.peak_device_bytes), 2),
    Measure("peak GPU memory, reserved (GiB)", _in(GIB, lambda run: run.peak_reserved_bytes), 2),
    Measure("peak RAM (GiB)", _in(GIB, lambda run: run.peak_rss_bytes), 2),
    Measure("blocks on disk (MiB)", _in(MIB, lambda run: run.store_bytes), 1),
)


def cell(runs: Sequence[Run], measure: Measure) -> str:
    """The measure of a method's runs: a number, or mean and standard deviation over the seeds (n - 1)."""
    values = [measure.value(run) for run in runs]
    if not values or any(value is None for value in values):
        return NOTHING
    text = f"{fmean(values):,.{measure.digits}f}"
    return text if len(values) == 1 else f"{text} ± {stdev(values):,.{measure.digits}f}"


def budget_of(seconds: float | None, steps: int | None) -> str:
    """A run's budget in words."""
    return f"{steps:,} steps" if seconds is None else f"{seconds:g} s of training"


def seeds_in_words(seeds: Sequence[int]) -> str:
    """ "seed 0" or "seeds 0, 1"."""
    return ("seed " if len(seeds) == 1 else "seeds ") + ", ".join(map(str, seeds))


def about_machine(machine: Machine) -> str:
    """One sentence about what the runs ran on."""
    return (
        f"{machine.cpu}, {machine.cores} cores, {machine.torch_threads} torch threads, "
        f"{machine.ram_bytes / 2**30:.0f} GiB RAM, {machine.gpu or 'no GPU'}, {machine.os}."
    )


def markdown(rows: Sequence[Sequence[str]], notes: Sequence[str]) -> str:
    """A table, its first row the titles, and below it a list of notes."""
    titles, *body = rows
    lines = ["| " + " | ".join(row) + " |" for row in body]
    head = "| " + " | ".join(titles) + " |"
    rule = "| --- |" + " ---: |" * (len(titles) - 1)
    return "\n".join([head, rule, *lines, "", *(f"- {note}" for note in notes), ""])


def print_rows(rows: Sequence[Sequence[str]], notes: Sequence[str], console: Console) -> None:
    """The same in the terminal."""
    titles, *body = rows
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for i, title in enumerate(titles):
        table.add_column(title, justify="right" if i else "left", no_wrap=True)
    for row in body:
        table.add_row(*row)
    width = console.width
    # Wider than a narrow terminal rather than with numbers cut off.
    needed = Measurement.get(console, console.options.update(width=1000), table).maximum
    console.width = max(width, needed)
    console.print(table)
    console.width = width
    for note in notes:
        console.print(f"- {note}", highlight=False, markup=False, soft_wrap=True)
