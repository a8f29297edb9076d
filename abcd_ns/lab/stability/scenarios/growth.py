"""A5, A6, A7: density control that never ends, undoes what was learnt, or never begins."""

from dataclasses import replace
from itertools import pairwise

import torch

from abcd_ns.engine.events import Event, StepTaken
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.clock import DensityClock
from abcd_ns.engine.train.density.control import LEAST_REFINEMENTS, DensityConfig, DensityControl
from abcd_ns.engine.train.memory import OutOfRoomError, check_room
from abcd_ns.lab.stability.lab import PAIR, Lab, make_stage
from abcd_ns.lab.stability.outcome import Finding, scenario
from abcd_ns.lab.stability.scenarios.freshness import objectives
from abcd_ns.lab.world.world import ring

CAP = 300
CAMERAS = (1, 2, 3, 10, 100, 1000, 2900, 15_000)
EVERY = 100
"""Steps between splatfacto's refinements."""
REFINE_EVERY = 25
"""Views: a few refinements in the warm-up and in each visit."""
FAINT = 0.01
"""Splatfacto's opacity after a reset."""
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
    f"a refinement after every {REFINE_EVERY} views, in the warm-up and in visits",
    f"no step leaves all Gaussians faint, no visit leaves over {ALLOWED_RISE:.0%} more error over all photos",
    cost=6,
)
def resets(lab: Lab) -> Finding:
    """A6: density control as often as there may be any; the objective after every visit."""
    stage = make_stage(views=ring(12), points=400)
    density = DensityConfig(refine_every=REFINE_EVERY, refine_start=0.0)
    options = {"budget": lab.views_drawn(1200), "blocks": 3, "density": density}
    coordinator = lab.coordinator(stage.start(), stage.views, **options)
    faint = steps_that_left_all_faint(coordinator)
    errors = objectives(lab, stage, coordinator)
    worst = max(after / before - 1 for before, after in pairwise(errors))
    said = {"abcd": f"{len(faint)} steps left all faint, worst visit {worst:+.0%}"}
    numbers = {"steps that left all faint": len(faint), "worst rise": worst}
    return Finding(not faint and worst <= ALLOWED_RISE, said, numbers)


def steps_that_left_all_faint(coordinator: Coordinator) -> list[int]:
    """Filled while it trains: steps after which no Gaussian is more opaque than a reset leaves it."""
    found, params = [], coordinator.params
    most = 1.01 * FAINT

    def listen(event: Event) -> None:
        opacities = params["opacities"].detach().sigmoid()
        if isinstance(event, StepTaken) and len(opacities) and float(opacities.max()) <= most:
            found.append(event.step)

    coordinator.announce.subscribe(listen)
    return found


def refinements(cameras: int, steps: int = 30_000) -> int:
    """How often a scene that `cameras` see is refined in a whole run."""
    control, found = DensityControl(DensityConfig()), [0]
    for step in range(1, steps + 1):
        clock = DensityClock(step / steps, step, 1, cameras, None, 0, refined=found[-1])
        found += [step] if control.is_due(clock) else []
    return len(found) - 1


def splatfacto_refines(cameras: int, steps: int = 15_000) -> int:
    """nerfstudio 1.1.5: not before `cameras` + 100 steps after a reset, and resets are 3,000 steps apart."""
    reset = 3000
    return sum(step % EVERY == 0 and step % reset >= cameras + EVERY for step in range(500, steps))


@scenario(
    "A7",
    "never densifies from 2,900 images on (nerfstudio #2927, #3743)",
    "the schedule of 30,000 steps for 1 to 15,000 cameras, and splatfacto's",
    f"at least {LEAST_REFINEMENTS} refinements",
)
def thousands(lab: Lab) -> Finding:  # noqa: ARG001 - a schedule needs no training
    """A7: the schedule alone, for captures of 1 to 15,000 photos."""
    found = {cameras: refinements(cameras) for cameras in CAMERAS}
    never = [cameras for cameras in CAMERAS if splatfacto_refines(cameras) == 0]
    said = {
        "abcd": f"{min(found.values())} to {max(found.values())} refinements with {CAMERAS[0]} to "
        f"{CAMERAS[-1]:,} cameras",
        "splatfacto": f"none at all from {min(never):,} cameras on",
    }
    passed = all(count >= LEAST_REFINEMENTS for count in found.values())
    return Finding(passed, said, {f"refinements at {cameras}": count for cameras, count in found.items()})
