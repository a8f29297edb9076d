"""`abcd plan`: what a run on these photos needs, and what would not fit."""

import math
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from abcd_ns.arguments import check_ranges
from abcd_ns.cli.plan import Wanted
from abcd_ns.data.prepare import SceneOptions, read_scene
from abcd_ns.engine.space.partition import MAX_BLOCKS
from abcd_ns.errors import UserError


@tyro.conf.configure(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
def plan(
    data: Annotated[Path, tyro.conf.arg(metavar="PATH")],
    wanted: Annotated[Wanted, tyro.conf.arg(name="")],
    downscale: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    verbose: bool = False,
) -> int:
    """Predict blocks, memory, disk and time of a run. Trains nothing.

    Times one step. This compiles the kernels if no training has done so yet.

    abcd plan --data garden

    abcd plan --data garden --device-budget-gb 6

    Args:
        data: Folder of the scene, as for `ns-train abcd --data`.
        wanted: Options of the run.
        downscale: Divides the photos' width and height. Left out, no side is over 1600 px, as in training.
        verbose: Show what takes the memory, and the points of the blocks.

    Returns:
        0; 1 if something would not fit.
    """
    if not 0 <= wanted.blocks <= MAX_BLOCKS:
        raise UserError(f"--blocks is {wanted.blocks}; it must lie between 0 and {MAX_BLOCKS}.")
    if not 0 <= wanted.device_budget_gb < math.inf:
        raise UserError(f"--device-budget-gb must be 0 or more and finite, not {wanted.device_budget_gb}.")
    given = {name: getattr(wanted, name) for name in ("max_gaussians", "steps", "workers")}
    check_ranges({**given, "downscale": downscale})
    if not data.exists():
        read_scene(SceneOptions(data=data))  # refuses it at once, with advice
    from abcd_ns.cli.plan.forecast import forecast, print_forecast, read  # loads nerfstudio, in seconds

    console = Console()
    found = forecast(read(data, downscale, console), wanted, console)
    print_forecast(found, console, verbose)
    return 1 if found.warnings else 0
