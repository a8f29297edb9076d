"""The tables of docs/results/README.md, made of the JSON beside it.

python -m benchmarks.tables

A comment above a table names its files; another one ends it.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from abcd_ns.lab.results.records import read_record
from abcd_ns.lab.results.results import SCHEMA, Arm, Results
from abcd_ns.lab.results.tables import MEASURES, NOTHING, cell, markdown
from abcd_ns.units import MIB

PAGE = Path(__file__).resolve().parent.parent / "docs" / "results" / "README.md"
TABLE = re.compile(r"(?<=<!-- table: )(.+?) -->\n(?:\|.*\n)*(?=<!-- end -->)")
NAMES = {"abcd-monolithic": "one block"}
PSNR = next(measure for measure in MEASURES if measure.field == "psnr_merged")


def with_tables(text: str, folder: Path) -> str:
    """A page with its tables as the files in a folder have them."""

    def made(found: re.Match[str]) -> str:
        return f"{found[1]} -->\n{table([folder / name for name in found[1].split()], folder)}\n"

    return TABLE.sub(made, text)


def table(paths: Sequence[Path], folder: Path) -> str:
    """A row for each thing set, a column for each method; mean and standard deviation over the seeds."""
    every = {path: read_record(path, Results, SCHEMA) for path in paths}
    methods = list(dict.fromkeys(method for results in every.values() for method in results.methods))
    found = [["scene", "", *(NAMES.get(method, method) for method in methods)]]
    for path, results in every.items():
        link = f"[{path.stem}]({path.relative_to(folder).as_posix()})"
        for variant, arms in _by_variant(results):
            found.append([link, variant, *(_in_words(arms[m]) if m in arms else NOTHING for m in methods)])
            link = ""
    return markdown(found)


def _by_variant(results: Results) -> Iterator[tuple[str, dict[str, Arm]]]:
    """What is set, memory as a share of what the first arm took, and by method the arms in which it is."""
    for variant in dict.fromkeys(arm.variant for arm in results.arms):
        arms = {arm.method: arm for arm in results.arms if arm.variant == variant}
        (arm, *_) = arms.values()
        words = results.labels[arm.name].removeprefix(arm.method).lstrip(", ")
        if arm.is_budgeted:
            words = f"1/{results.arms[0].mean('gaussian_bytes') / arm.value:.0f}"
        yield "" if variant == "default" else words, arms


def _in_words(arm: Arm) -> str:
    count = f", {arm.mean('blocks'):.0f} blocks" if arm.mean("blocks") > 1 else ""
    if arm.runs[0].memory is None:
        found = f"{cell(arm.runs, PSNR)} dB, {arm.mean('ssim_merged'):.3f}".replace(" 0.", " .")
    else:  # on a terrain nothing is held out
        found = f"{arm.mean('peak_rss_bytes') / MIB:,.0f} MiB"
    return f"{found}<br>{arm.mean('gaussians'):,.0f}{count}, {arm.mean('train_seconds'):.0f} s"


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(), PAGE.parent))
