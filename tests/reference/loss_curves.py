"""How every method of `ns-train` fares on a tiny scene, step by step, as it is kept in loss_curves.json.

    python -m tests.reference.loss_curves

writes that file anew: where a change is meant to change what is learnt, and says so.
"""

import json
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import torch

from abcd_ns import methods
from abcd_ns.engine.events import Event, StepTaken
from abcd_ns.engine.store.coarse_model import stored_blocks
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.training_loop import train
from abcd_ns.peers.exact import ExactTrainer
from abcd_ns.peers.independent import independent_blocks, independent_trainer
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views

CURVES = Path(__file__).with_suffix(".json")
STEPS, BLOCKS, COARSE_MODEL = 24, 4, 60
METHODS = ("abcd", "abcd_ablated", "abcd_partition", "abcd_exact", "abcd_paper", "abcd_monolithic")
OFTEN = {"refine_start": 0.1, "refine_every": 8, "split_pixels": 1.0}
"""So that such short runs grow."""


def options_of(method: str) -> dict:
    """What makes a method, by the options' own names."""
    training: TrainingConfig = getattr(methods, method).config.pipeline.training
    values, default = vars(training), vars(TrainingConfig())
    own = values.keys() - {"recipe", "limits", "density"}
    changed = {name: values[name] for name in own if values[name] != default[name]}
    changed["density"] = replace(training.density, **OFTEN)
    recipe = {**asdict(training.recipe), "passes": 4}
    return {**changed, **recipe, "visit_steps": 5 * (training.recipe.visit_steps > 0)}


def curve_of(method: str, folder: Path) -> dict[str, list[float]]:
    """PSNR of what each step drew, dB, and the scene's Gaussians after it."""
    views = ring_of_views(5)
    photos = Photos(random_gaussians(150, seed=7, size=0.12), views)
    start = random_gaussians(120, seed=1, size=0.12)
    options = options_of(method)
    kind, content = None, stored_blocks
    if options["exact"]:
        kind = ExactTrainer
    elif options["overlap"] > 0:
        kind, content = independent_trainer, independent_blocks
    blocks = 1 if method == "abcd_monolithic" else BLOCKS
    if blocks > 1 and options.get("warmup", 1) > 0:
        options["coarse_model"] = COARSE_MODEL
    options |= {"blocks": blocks, "steps": STEPS, "kind": kind, "content": content}
    trainer = make_coordinator(folder, start, views, **options)
    found: dict[str, list[float]] = {"psnr": [], "gaussians": []}

    def note(event: Event) -> None:
        if isinstance(event, StepTaken):
            found["psnr"].append(event.psnr)
            found["gaussians"].append(trainer.count())

    trainer.announce.subscribe(note)
    train(trainer, photos)
    trainer.close()
    return found


def main() -> None:
    torch.set_num_threads(1)
    curves = {}
    for method in METHODS:
        with tempfile.TemporaryDirectory() as folder:
            curve = curve_of(method, Path(folder))
        curves[method] = {**curve, "psnr": [round(value, 4) for value in curve["psnr"]]}
    CURVES.write_text(json.dumps(curves) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
