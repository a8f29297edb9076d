"""`abcd demo`: the main job from end to end, on a scene of its own, through nerfstudio's commands."""

import json
import math
import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from PIL import Image
from rich.console import Console

from abcd_ns.cli.terminal import print_facts, print_plain
from abcd_ns.errors import UserError
from abcd_ns.lab.compare.pictures import psnr_of, read_picture
from abcd_ns.lab.runs.runner import take_folder, taking

SCENE = {"courts": 1, "views_per_court": 56, "width": 256, "height": 192, "points_per_court": 24_000}
"""What two minutes on two cores suffice for: views that overlap, and points that need not multiply first."""
MARKER = "abcd-demo.txt"
"""Marks a folder that this command made."""
ENLARGED = 4
"""By how much the closing picture is."""


class StepFailed(Exception):
    """A command that the demo started failed; the message names it and its output."""


class Steps:
    """Headers with the time that has passed, and child processes that are waited for."""

    def __init__(self, console: Console, logs: Path) -> None:
        self._console, self._logs = console, logs
        self._began = time.monotonic()

    @property
    def seconds(self) -> float:
        """Since the demo began."""
        return time.monotonic() - self._began

    def begin(self, title: str) -> None:
        """Print a step's header."""
        minutes, seconds = divmod(int(self.seconds), 60)
        self._console.print(f"\n[bold]{minutes}:{seconds:02d}  {title}[/]", highlight=False)

    def run(self, name: str, command: Sequence[object], *, quiet: bool = True) -> None:
        """Run a command to its end.

        Args:
            quiet: its output goes to a log file instead of the terminal.

        Raises:
            StepFailed: it exited with another code than 0.
        """
        words = list(map(str, command))
        typed = ["abcd", *words[3:]] if words[1:2] == ["-m"] else [name, *words[1:]]
        self._console.print(f"$ {' '.join(typed)}", style="dim", markup=False, emoji=False, soft_wrap=True)
        log = self._logs / f"{name}.log"
        with open(log if quiet else os.devnull, "wb") as stream:
            output = {"stdout": stream, "stderr": subprocess.STDOUT} if quiet else {}
            code = subprocess.run(words, stdin=subprocess.DEVNULL, check=False, **output).returncode
        if code != 0:
            where = f"see {log}" if quiet else "see its output above"
            raise StepFailed(f"{name} failed with exit code {code}; {where}.")


def demo(
    *,
    out: Path = Path("demo"),
    seconds: Annotated[float, tyro.conf.arg(metavar="S")] = 120.0,
    blocks: Annotated[int, tyro.conf.arg(metavar="N")] = 4,
) -> int:
    """Make a small scene, train it block by block, score it and export it. Needs no GPU and no data.

    Runs `abcd synth`, `ns-train abcd`, `ns-eval`, `ns-export gaussian-splat` and `abcd report`.

    Args:
        out: Folder for everything that is made; absent, empty, or an earlier demo's.
        seconds: Time for training. The rest takes about a minute on two cores.
        blocks: Number of blocks.

    Raises:
        UserError: `out` holds something else or cannot be written, an option is out of range, or nerfstudio
            is not installed.
    """
    if not 0 < seconds < math.inf:
        raise UserError(f"--seconds is {seconds}; it must be above 0 and finite.")
    if blocks < 1:
        raise UserError(f"--blocks is {blocks}; it must be at least 1.")
    console = Console()
    logs = out / "logs"
    with taking(out):
        take_folder(out, out / MARKER, "demo")
        (out / MARKER).write_text("Made by `abcd demo`. Everything here may be deleted.\n", encoding="utf-8")
        logs.mkdir(exist_ok=True)
    try:
        _carry_out(Steps(console, logs), out, seconds, blocks, console)
    except StepFailed as error:
        print_plain(f"error: {error}", console, style="bold red")
        return 1
    return 0


def _carry_out(steps: Steps, out: Path, seconds: float, blocks: int, console: Console) -> None:
    scene, ply, page = out / "scene", out / "splat.ply", out / "report.html"
    steps.begin(f"1/5  A scene: a walled court, seen by {SCENE['views_per_court']} cameras")
    flags = [word for name, value in SCENE.items() for word in (f"--{name.replace('_', '-')}", value)]
    steps.run("synth", [*_abcd("synth"), scene, *flags, "--overwrite"])
    steps.begin(f"2/5  Training in {blocks} blocks for {seconds:g} s")
    began = steps.seconds
    run, peak = _train(steps, out, scene, seconds, blocks)
    trained = steps.seconds - began
    load = ["--load-config", run / "config.yml"]
    steps.begin("3/5  Scores and pictures of held-out views")
    found = out / "eval" / "results.json"
    evaluate = [*load, "--output-path", found, "--render-output-path", found.parent]
    steps.run("ns-eval", [_tool("ns-eval"), *evaluate])
    scores = json.loads(found.read_text(encoding="utf-8"))["results"]
    steps.begin("4/5  Export for other viewers")
    export = [*load, "--output-dir", out, "--output-filename", ply.name]
    steps.run("ns-export", [_tool("ns-export"), "gaussian-splat", *export])
    steps.begin("5/5  A report about the run")
    steps.run("report", [*_abcd("report"), run, "--data", scene, "--out", page])
    steps.begin("Done")
    facts = {
        "held-out PSNR": f"{scores['psnr']:.2f} dB",
        "held-out SSIM": f"{scores['ssim']:.3f}",
        "Gaussians": f"{_count(ply):,}",
        "peak RAM of training": f"{peak / 2**30:.2f} GiB",
        "time": f"{steps.seconds:.0f} s, training {trained:.0f} s of it",
        "report": str(page),
        "photo | rendering": str(_closing_picture(out)),
        "Gaussians for viewers": str(ply),
    }
    print_facts(facts, console)
    console.print("\nNext:", highlight=False)
    for command, what in {
        f"ns-viewer --load-config {run / 'config.yml'}": "look around in it",
        f"abcd compare --data {scene} --seconds 60 --blocks 4 --out comparison": "compare with one block",
        "ns-train abcd --data FOLDER": "train on your own photographs (a COLMAP model or transforms.json)",
    }.items():
        print_plain(f"  {command}\n      {what}", console)


def _train(steps: Steps, out: Path, scene: Path, seconds: float, blocks: int) -> tuple[Path, int]:
    """The run's folder, and the most RAM, in bytes, that a child of this process has taken so far."""
    stamp = time.strftime("%Y-%m-%d_%H%M%S")
    words = ["abcd", "--data", scene.resolve(), "--output-dir", out / "training", "--experiment-name", "demo"]
    words += ["--timestamp", stamp, "--vis", "tensorboard", "--viewer.quit-on-train-completion", True]
    words += ["--pipeline.blocks", blocks, "--pipeline.max-seconds", f"{seconds:g}"]
    # The seconds end the run; evaluations meanwhile would only make the demo longer.
    words += ["--max-num-iterations", 10**9, "--steps-per-save", 10**9]
    words += ["--steps-per-eval-image", 0, "--steps-per-eval-all-images", 0]
    steps.run("ns-train", [_tool("ns-train"), *words], quiet=False)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    # In KiB, but on macOS.
    return out / "training" / "demo" / "abcd" / stamp, peak * (1 if sys.platform == "darwin" else 1024)


def _closing_picture(out: Path) -> Path:
    """The held-out view of median PSNR, enlarged. ns-eval leaves photo and rendering side by side."""

    def psnr(pair: Path) -> float:
        both = read_picture(pair)
        return psnr_of(both[:, : both.shape[1] // 2], both[:, both.shape[1] // 2 :])

    pairs = sorted((out / "eval").glob("eval_img_*.png"), key=psnr)
    with Image.open(pairs[len(pairs) // 2]) as image:
        size = ENLARGED * image.width, ENLARGED * image.height
        image.resize(size, Image.Resampling.BICUBIC).save(path := out / "court.png")
    return path


def _count(ply: Path) -> int:
    """How many Gaussians the header of the exported file names."""
    with open(ply, "rb") as file:
        return int(re.search(rb"^element vertex (\d+)$", file.read(1024), re.MULTILINE)[1])


def _tool(name: str) -> str:
    """The command of nerfstudio that lies beside this Python."""
    path = Path(sys.executable).with_name(name)
    if not path.exists():
        raise UserError(f"{path} is missing; install nerfstudio into the environment of this command.")
    return str(path)


def _abcd(command: str) -> list[str]:
    """A command of ours, in the environment of this one."""
    return [sys.executable, "-m", "abcd_ns.cli.main", command]
