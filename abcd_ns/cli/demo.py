"""`abcd demo`: the main job from end to end, on a scene of its own, through the commands that users type."""

import math
import subprocess
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from abcd_ns.arguments import check_ranges
from abcd_ns.cli.report.story import read_story
from abcd_ns.cli.train import tool
from abcd_ns.errors import UserError
from abcd_ns.lab.runs.runner import take_folder, taking
from abcd_ns.lab.world.table_scene import LAST, draw_table
from abcd_ns.nerfstudio.run.log_lines import EndLine, HeldOutLine
from abcd_ns.nerfstudio.run.run_log import LOG_FILE
from abcd_ns.run import STATE
from abcd_ns.terminal import print_facts, print_plain
from abcd_ns.units import bytes_in_words
from abcd_ns.viewer.texts import clock

SCENE = {"count": 56, "size": (256, 192), "points": 24_000}
"""What two minutes on two cores suffice for: views that overlap, and points that need not multiply first."""
MARKER = "abcd-demo.txt"  # marks a folder that this command made
NEVER = 10**9  # steps between checkpoints and evaluations: the seconds end the run, and its end has both


def demo(
    *,
    out: Path = Path("demo"),
    seconds: Annotated[float, tyro.conf.arg(metavar="S")] = 120.0,
    blocks: Annotated[int, tyro.conf.arg(metavar="N")] = 4,
) -> int:
    """Make a small scene, train it block by block, export it and write a report. Needs no GPU and no data.

    Draws five balls on a table, and runs `ns-train abcd`, `ns-export gaussian-splat` and `abcd report`.

    Args:
        out: Folder for the results: new, empty, or of an earlier demo.
        seconds: Training time. The rest takes about a minute on two cores.
        blocks: Number of blocks.
    """
    check_ranges({"blocks": blocks})
    if not 0 < seconds < math.inf:
        raise UserError(f"--seconds is {seconds}; it must be above 0 and finite.")
    with taking(out):
        take_folder(out, out / MARKER, "demo")
        (out / MARKER).write_text("Made by `abcd demo`. Everything here may be deleted.\n", encoding="utf-8")
        (out / "logs").mkdir(exist_ok=True)
    run = out / "training" / "demo" / "abcd" / time.strftime("%Y-%m-%d_%H%M%S")
    console, began = Console(), time.monotonic()
    steps = {"A scene: five balls on a table": partial(_draw_scene, out / "scene")}
    for title, command in _commands(out, run, seconds, blocks).items():
        steps[title] = partial(_run, command, out / "logs", console)
    for number, (title, step) in enumerate(steps.items(), 1):
        now = clock(time.monotonic() - began)
        console.print(f"\n[bold]{now}  {number}/{len(steps)}  {title}[/]", highlight=False)
        step()
    _sum_up(out, run, seconds, time.monotonic() - began, console)
    return 0


def _commands(out: Path, run: Path, seconds: float, blocks: int) -> dict[str, list[str]]:
    """What is typed, one after the other, by what it does."""
    never = "max-num-iterations", "steps-per-save", "steps-per-eval-image", "steps-per-eval-all-images"
    options = {
        "data": (out / "scene").resolve(),
        "output-dir": run.parents[2],
        "experiment-name": run.parents[1].name,
        "timestamp": run.name,
        "vis": "tensorboard",
        "viewer.quit-on-train-completion": True,
        "pipeline.blocks": blocks,
        "pipeline.max-seconds": f"{seconds:g}",
        **dict.fromkeys(never, NEVER),
    }
    exported = {"load-config": run / "config.yml", "output-dir": out, "output-filename": "splat.ply"}
    page = {"data": out / "scene", "out": out / "report.html"}
    return {
        "Training": ["ns-train", "abcd", *_flags(options)],
        "Export for other viewers": ["ns-export", "gaussian-splat", *_flags(exported)],
        "A page about the run": ["abcd", "report", str(run), *_flags(page)],
    }


def _draw_scene(scene: Path) -> None:
    """Draw it, unless an earlier demo has."""
    if not (scene / LAST).exists():
        with taking(scene):
            draw_table(scene, **SCENE)


def _flags(options: Mapping[str, Any]) -> list[str]:
    return [word for name, value in options.items() for word in (f"--{name}", str(value))]


def _run(command: Sequence[str], logs: Path, console: Console) -> None:
    """Run a command to its end. Its output goes to the terminal if it trains, else to a file of `logs`."""
    print_plain(f"$ {' '.join(command)}", console, style="dim")
    program, *words = command
    name = words[0] if program == "abcd" else program
    log, shown = logs / f"{name}.log", program == "ns-train"
    with open(log, "wb") as file:
        output = {} if shown else {"stdout": file, "stderr": subprocess.STDOUT}
        done = subprocess.run([tool(program), *words], stdin=subprocess.DEVNULL, check=False, **output)
    if done.returncode != 0:
        where = "its output above" if shown else log
        raise UserError(f"{name} failed with exit code {done.returncode}; see {where}.")


def _sum_up(out: Path, run: Path, seconds: float, taken: float, console: Console) -> None:
    story = read_story(run / STATE / LOG_FILE)
    scores, end = story.last(HeldOutLine), story.last(EndLine)
    missed = sum(not story.of_block(block) for block in range(story.blocks)) if story.visits else 0
    console.print("\n[bold]Done[/]")
    facts = {
        "held-out PSNR": f"{scores.psnr:.2f} dB, SSIM {scores.ssim:.3f}" if scores else "not measured",
        "Gaussians": f"{story.gaussians:,}",
        "peak RAM": f"{bytes_in_words(end.peak_rss_bytes)} in training" if end else "not measured",
        "not visited": f"{missed} of {story.blocks} blocks",
        "time": f"{taken:.0f} s, training {story.end.seconds:.0f} s of it",
        "report": str(out / "report.html"),
        "Gaussians for viewers": str(out / "splat.ply"),
    }
    print_facts(facts, console)
    steps = {
        f"ns-viewer --load-config {run / 'config.yml'}": "look around in it",
        f"abcd demo --seconds {2 * seconds:g}": "train longer",
        f"abcd compare --data {out / 'scene'} --seconds 60 --blocks 4 --out comparison": "against one block",
        "abcd check --data FOLDER": "see whether your own photos can be trained on",
    }
    lines = (f"  {command}\n      {what}" for command, what in steps.items())
    print_plain("\n".join(["\nNext:", *lines]), console)
