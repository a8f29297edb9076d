"""What a last shedding takes out and costs: held-out views of one run right before it and after.

python -m benchmarks.last_shedding --data DIR --steps 500 --blocks 1 --out OUT.json
"""

import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import tyro

from abcd_ns.engine.events import Event, ShedAtEnd, Shedding
from abcd_ns.lab.compare.command import Options, make_plan
from abcd_ns.lab.runs.evaluate import draw_held_out, mean, score
from abcd_ns.lab.runs.worker import set_up
from abcd_ns.machine import describe_versions

SCORES = ("psnr_merged", "ssim_merged")


@dataclass(frozen=True)
class Args:
    """A scene and how long it is trained."""

    data: Path
    out: Path
    steps: int = 500
    blocks: int = 1
    downscale: int = 4
    seed: int = 0


def main(args: Args) -> None:
    """Train, look before and after, write what was found."""
    method, given = "abcd-monolithic" if args.blocks == 1 else "abcd", vars(args)
    asked = {name: given[name] for name in ("steps", "blocks", "downscale")}
    where = {"data": str(args.data), "out": str(args.out)}
    plan = make_plan(Options(methods=(method,), seeds=(args.seed,), evals=1, pictures=0, **where, **asked))
    found = {"args": {name: str(value) for name, value in {**asked, "seed": args.seed}.items()}}
    with TemporaryDirectory() as folder:
        training = set_up(plan.jobs[0], Path(folder))

        def look() -> dict[str, float | None]:
            scores = [score(drawn) for drawn in draw_held_out(training.pipeline)]
            return {name: mean([getattr(each, name) for each in scores]) for name in SCORES}

        def listen(event: Event) -> None:
            match event:
                case Shedding(done=0):
                    found["training_seconds"] = training.stopwatch.seconds
                    found["held_out_before"], found["began"] = look(), time.perf_counter()
                case ShedAtEnd():
                    found["shedding_seconds"] = time.perf_counter() - found.pop("began")
                    found["shed"], found["held_out_after"] = asdict(event), look()

        training.coordinator.announce.subscribe(listen)
        training.trainer.train()
    found |= {"threads": torch.get_num_threads(), "versions": asdict(describe_versions())}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps({"scene": plan.settings.scene, **found}, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
