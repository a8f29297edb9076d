"""Quality within a memory budget: which runs, and the chart."""

import dataclasses
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from abcd_ns.errors import UserError
from abcd_ns.lab.job import METHODS, Job, Plan
from abcd_ns.lab.results.results import Arm, Results
from abcd_ns.lab.results.style import COLORS, MARKERS, in_style, lay_grid, save
from abcd_ns.units import MIB

JOINT = "abcd-monolithic"
"""Of what this takes, budgets are shares; within one it has as many Gaussians as fit."""
WITHIN = ("abcd", JOINT, "abcd-ablated", "abcd-partition")  # methods that keep to a budget
ALONE = ("splatfacto", "splatfacto-scaled")  # ceilings, which keep to none
OPTION = "gaussian_bytes"  # that sets a budget
QUALITY = {"psnr_merged": "held-out PSNR (dB)", "ssim_merged": "held-out SSIM"}
"""By field of a run, what the chart shows of it."""


def shares_of(texts: Sequence[str]) -> list[Fraction]:
    """The budgets, the largest first; a UserError where one is no share."""
    try:
        found = {Fraction(text) for text in texts}
    except (ValueError, ZeroDivisionError):
        found = set()
    if not found or min(found) <= 0 or max(found) > 1:
        raise UserError(f"--budgets {' '.join(texts)}: give shares above 0 and up to 1, such as 1/4.")
    return sorted(found, reverse=True)


def within_budgets(plan: Plan, ceilings: Results, methods: Sequence[str], shares: Sequence[Fraction]) -> Plan:
    """The plan, and methods within shares of the memory of joint training; a UserError where that failed."""
    took = [run.gaussian_bytes for run in ceilings.runs if run.method == JOINT]
    if not took:
        raise UserError(f"{JOINT} failed, of whose memory the budgets are shares; see its log.")
    jobs = tuple(
        Job(method, seed, plan.settings, (f"{OPTION}={int(share * max(took))}",))
        for seed in ceilings.seeds
        for share in shares
        for method in METHODS
        if method in WITHIN and method in (*methods, JOINT)
    )
    return dataclasses.replace(plan, jobs=(*plan.jobs, *jobs))


@in_style
def draw_budgets(results: Results, out: Path) -> list[Path]:
    """Write PSNR and SSIM over peak memory as png into `out`; nothing where no arm has a budget."""
    arms = [arm for arm in results.arms if all(run.gaussian_bytes for run in arm.runs)]
    if not any(is_budgeted(arm) for arm in arms):
        return []
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    for axes, (field, title) in zip(figure.subplots(1, 2), QUALITY.items(), strict=True):
        lay_grid(axes)
        for method in results.methods:
            own = sorted((arm for arm in arms if arm.method == method), key=_mebibytes)
            _draw_method(axes, method, own, field)
        axes.set(xscale="log", xlabel="peak memory of Gaussians (MiB)", ylabel=title)
        for which in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            which(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "125" else "")
    figure.suptitle(results.title, x=0.02, ha="left")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return [save(figure, out, "memory_accuracy")]


def _draw_method(axes: Axes, method: str, arms: Sequence[Arm], field: str) -> None:
    """A line through its budgets, bars from the lowest seed to the highest; dotted what no limit gives."""
    look = {"color": COLORS[method], "marker": MARKERS[method]}
    if within := [arm for arm in arms if is_budgeted(arm)]:
        means = [arm.mean(field) for arm in within]
        ends = [[getattr(run, field) for run in arm.runs] for arm in within]
        bars = [[mean - min(e), max(e) - mean] for mean, e in zip(means, ends, strict=True)]
        x = list(map(_mebibytes, within))
        axes.errorbar(x, means, list(zip(*bars, strict=True)), label=f"{method} within a budget", **look)
    for arm in arms:
        if not is_budgeted(arm):
            axes.axhline(arm.mean(field), color=look["color"], linewidth=0.8, linestyle=":")
            label = f"{method} without a limit"
            axes.plot([_mebibytes(arm)], [arm.mean(field)], linestyle="", label=label, **look)


def is_budgeted(arm: Arm) -> bool:
    """Whether its runs keep to a budget."""
    return arm.variant.startswith(OPTION)


def _mebibytes(arm: Arm) -> float:
    return arm.mean("gaussian_bytes") / MIB
