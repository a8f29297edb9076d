"""What `abcd scale` found, as a record, a table, and one number."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from abcd_ns.lab.runs.tables import GIB, MIB, NOTHING, about_machine, markdown, print_rows
from abcd_ns.lab.scale.arm import Arm
from abcd_ns.nerfstudio.machine import Machine, Versions

SCHEMA = 1
GOAL = 0.05
"""Growth of peak memory that is allowed from the smallest scene to the largest."""


@dataclass(frozen=True)
class Growth:
    """Peak memory of the largest scene by that of the smallest, less 1."""

    blocks: tuple[int, int]
    ram: float
    device: float | None


@dataclass(frozen=True)
class ScaleResults:
    """The whole of scale.json."""

    schema: int
    date: str
    command: str
    machine: Machine
    versions: Versions
    arms: tuple[Arm, ...]
    growth: Growth | None
    """Of ABCD; None with fewer than two sizes."""
    failures: tuple[str, ...]
    one_block_too_large: int | None = None
    """Tiles of the smallest scene that ran out of GPU memory as one block; larger ones were not tried so."""

    def of(self, monolithic: bool) -> list[Arm]:
        """ABCD's measurements or those of one block, the smallest scene first."""
        return sorted((arm for arm in self.arms if arm.monolithic == monolithic), key=lambda arm: arm.tiles)


def growth(arms: Sequence[Arm]) -> Growth | None:
    """How ABCD's memory grew from the smallest scene to the largest."""
    blocks = sorted((arm for arm in arms if not arm.monolithic), key=lambda arm: arm.tiles)
    if len(blocks) < 2:
        return None
    first, last = blocks[0], blocks[-1]
    device = None
    if first.peak_device_bytes and last.peak_device_bytes:
        device = last.peak_device_bytes / first.peak_device_bytes - 1
    return Growth((first.tiles, last.tiles), last.peak_rss_bytes / first.peak_rss_bytes - 1, device)


def rows_of(results: ScaleResults) -> list[list[str]]:
    """The table, titles first."""
    titles = ["", "Gaussians", "peak RAM (MiB)", "GPU (MiB)", "store (GiB)", "visit (s)", "layers (s)"]
    rows = [titles]
    for arm in [*results.of(monolithic=False), *results.of(monolithic=True)]:
        rows.append(
            [
                f"one block, {arm.tiles} tiles" if arm.monolithic else f"ABCD, {arm.tiles} blocks",
                f"{arm.gaussians:,}",
                f"{arm.peak_rss_bytes / MIB:,.0f}",
                NOTHING if arm.peak_device_bytes is None else f"{arm.peak_device_bytes / MIB:,.0f}",
                f"{arm.store_bytes / GIB:.2f}",
                NOTHING if arm.visit_seconds is None else f"{arm.visit_seconds:.1f}",
                NOTHING if arm.layer_seconds is None else f"{arm.layer_seconds:.1f}",
            ]
        )
    return rows


def notes_of(results: ScaleResults) -> list[str]:
    """What stands below the table."""
    notes = [about_machine(results.machine)]
    if results.arms:
        base = min(arm.base_rss_bytes for arm in results.arms)
        notes.append(f"Of the RAM, {base / MIB:,.0f} MiB are Python, torch and kernels, before any scene.")
    if results.growth is not None:
        (first, last), ram = results.growth.blocks, results.growth.ram
        device = results.growth.device
        more = "" if device is None else f", GPU memory by {device:.1%}"
        notes.append(
            f"From {first} to {last} blocks of ABCD, peak RAM grows by {ram:.1%}{more}; allowed: {GOAL:.0%}."
        )
    if results.one_block_too_large:
        notes.append(f"As one block, {results.one_block_too_large} tiles ran out of GPU memory.")
    notes += [f"Failed: {failure}" for failure in results.failures]
    return [*notes, f"Command: `{results.command}`, {results.date[:10]}."]


def write_table(results: ScaleResults, path: Path) -> None:
    """As Markdown."""
    path.write_text(markdown(rows_of(results), notes_of(results)), encoding="utf-8")


def print_results(results: ScaleResults, console: Console) -> None:
    """In the terminal."""
    print_rows(rows_of(results), notes_of(results), console)
