"""Draws the pictures of terminal screens and pages in docs/images.

    python scripts/screens.py --data fox --run outputs/fox/abcd/TIME

Screens become SVG, of what the commands really print. The page of a report is photographed by Chromium, if
there is one.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.text import Text

BIN = Path(sys.executable).parent
IMAGES = Path(__file__).resolve().parent.parent / "docs" / "images"
COLUMNS = 104
PAGE = (1100, 1500)
"""Pixels."""


@dataclass
class Args:
    """What to show."""

    data: Path
    """A scene; its folder's name is shown."""
    run: Path | None = None
    """A finished run on it; left out, the page of its report stays as it is."""
    downscale: int = 1
    """Divides the photos' size."""


def screen(name: str, words: list[str], folder: Path) -> None:
    """What a command prints, as docs/images/NAME.svg."""
    settings = {"COLUMNS": str(COLUMNS), "FORCE_COLOR": "1", "TTY_INTERACTIVE": "0", "TERM": "xterm-256color"}
    done = subprocess.run(
        [str(BIN / words[0]), *words[1:]],
        cwd=folder,
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        check=False,
    )
    with open(os.devnull, "w") as nowhere:
        console = Console(record=True, width=COLUMNS, file=nowhere, force_terminal=True)
        console.print(Text.from_ansi(f"$ {' '.join(words)}\n{done.stdout}{done.stderr}".rstrip()))
        svg = console.export_svg(title="", unique_id=name)
    # The reader's own fonts: no picture in the documents may need a network.
    svg = re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL)
    (IMAGES / f"{name}.svg").write_text(svg)
    print(f"{name}.svg: exit code {done.returncode}")


def page(name: str, path: Path) -> None:
    """A photograph of a page, as docs/images/NAME.png."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        print(f"{name}.png: no Chromium here")
        return
    width, height = PAGE
    with tempfile.TemporaryDirectory() as profile:
        words = [chromium, "--headless", "--no-sandbox", "--hide-scrollbars", f"--user-data-dir={profile}"]
        words += [f"--window-size={width},{height}", f"--screenshot={IMAGES / f'{name}.png'}"]
        subprocess.run([*words, path.resolve().as_uri()], check=True, capture_output=True)
    print(f"{name}.png")


def main(args: Args) -> None:
    """Draw all of them."""
    folder, data = args.data.resolve().parent, args.data.name
    screen("check", ["abcd", "check", "--data", data], folder)
    screen("plan", ["abcd", "plan", "--data", data, "--downscale", str(args.downscale)], folder)
    screen("doctor", ["abcd", "doctor"], folder)
    if args.run is None:
        return
    with tempfile.TemporaryDirectory() as scratch:
        report = Path(scratch) / "report.html"
        words = ["report", str(args.run), "--data", str(args.data), "--out", str(report)]
        subprocess.run([str(BIN / "abcd"), *words], check=True)
        page("report", report)


if __name__ == "__main__":
    main(tyro.cli(Args))
