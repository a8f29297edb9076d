"""The same faults in a capture of one's own: sparse views, noisy poses, exposure, repetition, far offsets."""

from dataclasses import replace
from pathlib import Path

import torch

from abcd_ns.errors import UserError
from abcd_ns.lab.stability.lab import BUDGET, PAIR, Lab, Stage
from abcd_ns.lab.stability.outcome import Finding, Scenario, against_one_block, db
from abcd_ns.lab.stability.scenarios.captures import GAINS, SHIFT, TURN_DEGREES, with_gains, with_noisy_poses
from abcd_ns.lab.stability.scenarios.sizes import surveyed

SPARSE = 8
THOUSANDS = 3000
"""Photos of a capture that shows everything over and over."""
OFFSET = 5e6
MOST_POINTS = 4000
"""More points than this are thinned out in scenarios, for time."""


def read_stage(data: Path, downscale: int, most_points: int | None = None) -> Stage:
    """A capture as `ns-train abcd --data` reads it; every 8th view held out. All photos are kept in RAM;
    masks and alpha channels are left aside.

    Args:
        most_points: of more, so many are taken by chance; None takes all in their order.

    Raises:
        UserError: it cannot be used; the message says why.
    """
    # Here and not above: loads nerfstudio.
    from abcd_ns.data.photos import Photos
    from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
    from abcd_ns.nerfstudio.views import training_views

    parser = AbcdDataParserConfig(data=data, downscale_factor=downscale).setup()
    splits = [parser.get_dataparser_outputs(split) for split in ("train", "test")]
    pictures = []
    for outputs in splits:
        photos = Photos(outputs.metadata["photos"])
        pictures.append([photos.image(row)[..., :3].float() / 255 for row in range(len(photos))])
    metadata = splits[0].metadata
    if "points3D_xyz" not in metadata:
        raise UserError(f"{data} has no points to begin with; the scenarios need some.")
    points = metadata["points3D_xyz"]
    views = training_views(splits[0].cameras, points)
    chosen = slice(None)
    if most_points is not None:
        chosen = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:most_points]
    return Stage(
        views,
        dict(enumerate(pictures[0])),
        points[chosen].double(),
        metadata["points3D_rgb"][chosen].float(),
        training_views(splits[1].cameras, points, views[0].near),
        pictures[1],
    )


def repeated(stage: Stage, count: int) -> Stage:
    """`count` views: every one again and again, each time under a number of its own."""
    shown = {number: stage.views[number % len(stage.views)] for number in range(count)}
    views = [replace(view, index=number) for number, view in shown.items()]
    photos = {number: stage.photos[view.index] for number, view in shown.items()}
    return replace(stage, views=views, photos=photos)


def real_scenarios(stage: Stage, name: str) -> tuple[Scenario, ...]:
    """Scenarios R1 to R5, on a capture."""

    def compared(changed: Stage):
        def run(lab: Lab) -> Finding:
            budget = lab.views_drawn(BUDGET)
            return against_one_block({m: lab.train(changed, m, budget=budget, blocks=8).psnr for m in PAIR})

        return run

    def thousands(lab: Lab) -> Finding:
        many, start = repeated(stage, THOUSANDS), stage.start()
        trained = lab.train(many, budget=lab.views_drawn(BUDGET))
        grown, visits = len(trained.gaussians) - len(start), trained.coordinator.state.visit
        said = {"abcd": f"{db(trained.psnr)}, {visits} visits, {grown:+,} Gaussians"}
        numbers = {"psnr": trained.psnr, "visits": visits, "grown": grown}
        return Finding(trained.coordinator.finished and grown > 0, said, numbers)

    def offset(lab: Lab) -> Finding:
        budget = lab.views_drawn(BUDGET // 2)
        at = [lab.train(surveyed(stage, d), budget=budget).psnr for d in (0.0, OFFSET)]
        said = {"abcd": f"{db(at[0])} at 0, {db(at[1])} at {OFFSET:g} m"}
        return Finding(abs(at[0] - at[1]) <= 0.05, said, {"at 0": at[0], "at offset": at[1]})

    rule = "held-out PSNR at least one block's less 0.3 dB"
    few = min(SPARSE, len(stage.views))
    noisy = with_noisy_poses(stage, TURN_DEGREES, SHIFT)
    noise = f"poses off by {TURN_DEGREES} degrees and {SHIFT:g} of the scene"
    return (
        Scenario("R1", "sparse views", f"{few} of {name}'s views", rule, compared(stage.only(few))),
        Scenario("R2", "noisy poses", f"{name}: {noise}", rule, compared(noisy)),
        Scenario(
            "R3",
            "changing exposure",
            f"{name}: every other photo {GAINS[1]} times as bright",
            rule,
            compared(with_gains(stage)),
        ),
        Scenario(
            "R4",
            "never densifies with thousands of photos",
            f"{name}: its views repeated up to {THOUSANDS:,}",
            "the run ends and its blocks are refined",
            thousands,
        ),
        Scenario(
            "R5",
            "UTM offsets eat float32",
            f"{name} in coordinates that begin at {OFFSET:g}",
            "PSNR within 0.05 dB",
            offset,
        ),
    )
