"""The way of someone who comes here for the first time: photos, poses, training, viewer, report, file.

    python -m benchmarks.first_time --photos fox/images --out first-time

Types the commands of docs/tutorial.md on a copy of the photos, one after the other, and times each.
"""

import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

BIN = Path(sys.executable).parent
ROOT = Path(__file__).resolve().parent.parent
SCENE = "SCENE"
"""What stands for the scene in the tutorial."""
NOT_HERE = re.compile(r"abcd train small-gpu|ns-render|--by-block|--box|--pipeline|^ns-train")
"""Commands of the tutorial that say the same once more, for other machines or other wishes."""
PATIENCE = 300.0
"""Seconds until the viewer's page must be there."""


@dataclass
class Args:
    """The way."""

    photos: Path
    """A folder of photos."""
    out: Path
    """A new folder, in which all happens."""
    training_seconds: float = 180.0
    """Of training: the tutorial's 15 minutes are long for a benchmark."""
    downscale: int = 2
    """Divides the photos' size while training."""


@dataclass(frozen=True)
class Step:
    """A command and how it went."""

    command: str
    seconds: float
    exit_code: int
    last_line: str


def commands(tutorial: str) -> Iterator[str]:
    """Of the numbered sections, those that are to be typed here."""
    numbered = tutorial.split("## How long it takes")[0]
    for block in re.findall(r"```bash\n(.*?)```", numbered, re.DOTALL):
        for line in block.splitlines():
            if not NOT_HERE.search(line):
                yield line.split(" #")[0].strip()


def type_in(command: str, out: Path) -> Step:
    """Run a command in the folder, as a shell would."""
    program, *words = command.split()
    began = time.monotonic()
    done = subprocess.run(
        [str(BIN / program), *words], cwd=out, capture_output=True, text=True, check=False, errors="replace"
    )
    said = (done.stdout + done.stderr).strip().splitlines()
    seconds = time.monotonic() - began
    number = len(list(out.glob("*.txt"))) + 1
    (out / f"{number}-{program}.txt").write_text(f"$ {command}\n{done.stdout}{done.stderr}")
    return Step(command, seconds, done.returncode, said[-1] if said else "")


def look(command: str, out: Path) -> Step:
    """Start a viewer, until its page is there."""
    began = time.monotonic()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    program, *words = command.split()
    words += ["--viewer.websocket-port", str(port)]
    address = f"http://127.0.0.1:{port}/"
    with (out / "viewer.txt").open("w") as said:
        process = subprocess.Popen([str(BIN / program), *words], cwd=out, stdout=said, stderr=said)
    try:
        while time.monotonic() - began < PATIENCE:
            try:
                with urllib.request.urlopen(address, timeout=5) as page:
                    seconds, size = time.monotonic() - began, len(page.read())
                    return Step(command, seconds, 0, f"a page of {size:,} bytes at {address}")
            except OSError:
                time.sleep(0.2)
    finally:
        process.terminate()
        process.wait()
    return Step(command, time.monotonic() - began, 1, "no page")


def main(args: Args) -> int:
    """Go the way; 1 if anything went wrong."""
    console = Console()
    scene = args.out / SCENE
    shutil.copytree(args.photos, scene / "images")
    steps: list[Step] = []
    for command in commands((ROOT / "docs" / "tutorial.md").read_text()):
        if "train" in command:
            command += f" --pipeline.max-seconds {args.training_seconds:g} --vis tensorboard"
            command += (
                f" --pipeline.datamanager.dataparser.downscale-factor {args.downscale} --timestamp TIME"
            )
        steps.append((look if command.startswith("ns-viewer") else type_in)(command, args.out))
        said = steps[-1]
        console.print(f"{said.seconds:7.1f} s  {said.exit_code}  {command}", markup=False, highlight=False)
        console.print(f"{'':12}{said.last_line}", markup=False, highlight=False)
    print("\n| command | seconds |\n| --- | ---: |")
    for step in steps:
        print(f"| `{step.command}` | {step.seconds:.0f} |")
    return int(any(step.exit_code for step in steps))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
