"""A5, A6, A7: density control that never ends, undoes what was learnt, or never begins."""

from dataclasses import replace
from itertools import pairwise

import torch

from abcd_ns.engine.events import Event, StepTaken
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.clock import DensityClock
from abcd_ns.engine.train.density.control import DensityConfig, DensityControl
from abcd_ns.engine.train.memory import OutOfRoomError, check_room
from abcd_ns.engine.train.schedule import passes_of_visit, views_per_step, views_per_visit
from abcd_ns.lab.stability.lab import PAIR, Lab, make_stage
from abcd_ns.lab.stability.outcome import Finding, scenario
from abcd_ns.lab.stability.scenarios.freshness import objectives
from abcd_ns.lab.world.world import ring

CAP = 300
PASSES, VIEWS = TrainingConfig().passes, TrainingConfig().visit_views
CAMERAS = (1, 2, 3, 10, 100, 1000, 2900, 15_000)
EVERY = DensityConfig().refine_every
"""Steps between refinements, splatfacto's, too."""
RESET_EVERY = 25
"""Views between resets: a few in the warm-up and, if blocks among others had any, in each of their visits."""
ALLOWED_BY_RESETS = 0.3
ALLOWED_RISE = 0.02
"""Of the mean absolute error over all training photos, by one visit."""


@scenario(
    "A5",
    "densification blows up; the cap is ignored at the start (desplat #5, gsplat #516)",
    "photos of noise, growth at the least gradient, twice as many points as the cap; a block of 10^12",
    "never over the cap, at any step; an error that names the fix before memory is taken",
)
def noise(lab: Lab) -> Finding:
    """A5: photos of noise, from twice as many points as there may be Gaussians; and a block too large."""
    stage, said, numbers, passed = make_stage(views=ring(12), points=2 * CAP), {}, {}, True
    draw = {"generator": torch.Generator().manual_seed(5)}
    photos = {index: torch.rand(photo.shape, **draw) for index, photo in stage.photos.items()}
    density = DensityConfig(max_gaussians=CAP, refine_start=0.0, refine_stop=1.0, split_pixels=0.0)
    for method in PAIR:
        options = {"budget": lab.views_drawn(300), "blocks": 4, "density": density}
        trained = lab.train(replace(stage, photos=photos), method, **options)
        most = max(trained.counts)
        numbers[f"most {method}"] = most
        said[method] = f"never over {most} of {CAP}"
        passed &= most <= CAP and trained.coordinator.finished
    try:
        check_room(10**12, 3, torch.device("cpu"))
    except OutOfRoomError as error:
        said["abcd"] += f'; "{str(error).split(";")[0]}"'
    else:
        passed = False
    return Finding(passed, said, numbers)


@scenario(
    "A6",
    "an opacity reset costs 2.7 to 7.6 dB (gsplat #1012)",
    f"a reset after every {RESET_EVERY} views, where there may be one; none",
    f"there are some; the warm-up ends with no more than {ALLOWED_BY_RESETS:.0%} more error over all photos "
    f"than without, and no visit leaves it more than {ALLOWED_RISE:.0%} higher",
    cost=6,
)
def resets(lab: Lab) -> Finding:
    """A6: opacity resets as often as there may be any; the objective after every visit."""
    stage, said, numbers = make_stage(views=ring(12), points=400), {}, {}
    for name, every in (("abcd", RESET_EVERY), ("abcd, no resets", 0)):
        density = DensityConfig(reset_every=every, refine_start=0.0)
        options = {"budget": lab.views_drawn(1200), "blocks": 3, "density": density}
        coordinator = lab.coordinator(stage.start(), stage.views, **options)
        faint = steps_that_left_all_faint(coordinator)
        errors = objectives(lab, stage, coordinator)
        worst = max(after / before - 1 for before, after in pairwise(errors))
        numbers |= {f"resets {name}": len(faint), f"warm {name}": errors[1], f"worst rise {name}": worst}
        said[name] = f"{len(faint)} resets, error {errors[1]:.3f} after the warm-up, worst visit {worst:+.0%}"
    harm = numbers["warm abcd"] / numbers["warm abcd, no resets"] - 1
    harmless = harm <= ALLOWED_BY_RESETS and numbers["worst rise abcd"] <= ALLOWED_RISE
    return Finding(numbers["resets abcd"] > 0 and harmless, said, numbers)


def steps_that_left_all_faint(coordinator: Coordinator) -> list[int]:
    """Filled while it trains: steps after which no Gaussian is more opaque than a reset leaves it."""
    found, params = [], coordinator.params
    most = 1.01 * 2 * coordinator.config.density.cull_alpha_thresh

    def listen(event: Event) -> None:
        opacities = params["opacities"].detach().sigmoid()
        if isinstance(event, StepTaken) and len(opacities) and float(opacities.max()) <= most:
            found.append(event.step)

    coordinator.announce.subscribe(listen)
    return found


def refinements(cameras: int) -> int:
    """How often a block that `cameras` see is refined in one visit, once it is warm."""
    control, done = DensityControl(DensityConfig()), 10 * max(cameras, 1)
    batch, used = views_per_step(0, 2, trained=done), views_per_visit(cameras, cameras, VIEWS)
    steps = -(-int(passes_of_visit(PASSES, used, 1, 2)) * used // batch)
    drawn = steps * batch
    clocks = [  # see LiveBlock.density_clock
        DensityClock(0.2, done + batch * (k + 1), batch, cameras, None, 0, visit=drawn) for k in range(steps)
    ]
    return sum(control.is_due(clock) for clock in clocks)


def splatfacto_refines(cameras: int, steps: int = 15_000) -> int:
    """nerfstudio 1.1.5: not before `cameras` + 100 steps after a reset, and resets are 3,000 steps apart."""
    reset = 3000
    return sum(step % EVERY == 0 and step % reset >= cameras + EVERY for step in range(500, steps))


@scenario(
    "A7",
    "never densifies from 2,900 images on (nerfstudio #2927, #3743)",
    "the schedule for 1 to 15,000 cameras, and splatfacto's",
    "at least one refinement in each visit that draws a hundred views or more; shorter ones, of fewer than "
    "13 cameras, gather statistics over several",
)
def thousands(lab: Lab) -> Finding:  # noqa: ARG001 - a schedule needs no training
    """A7: the schedule alone, for captures of 1 to 15,000 photos."""
    least = {cameras: refinements(cameras) for cameras in CAMERAS}
    never = [cameras for cameras in CAMERAS if splatfacto_refines(cameras) == 0]
    used = {cameras: views_per_visit(cameras, cameras, VIEWS) for cameras in CAMERAS}
    too_short = [c for c, views in used.items() if passes_of_visit(PASSES, views, 1, 2) * views < EVERY]
    passed = all(count >= 1 for cameras, count in least.items() if cameras not in too_short)
    said = {
        "abcd": f"at least {min(c for n, c in least.items() if n not in too_short)} refinement in each visit "
        f"of {min(set(CAMERAS) - set(too_short)):,} to {CAMERAS[-1]:,} cameras",
        "splatfacto": f"none at all from {min(never):,} cameras on",
    }
    return Finding(passed, said, {f"least at {cameras}": count for cameras, count in least.items()})
