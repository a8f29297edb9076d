"""What a run came to, in a few numbers."""

from dataclasses import dataclass

from abcd_ns.cli.report.held_out import HeldOut
from abcd_ns.cli.report.run_folder import RunFolder
from abcd_ns.cli.report.story import Story
from abcd_ns.cli.terminal import many
from abcd_ns.engine.train.memory import FLOAT
from abcd_ns.lab.results.tables import NOTHING
from abcd_ns.units import GIB, MIB
from abcd_ns.viewer.texts import clock


@dataclass(frozen=True)
class Fact:
    """A number of the headline."""

    name: str
    value: str
    unit: str = ""
    more: str = ""


def headline(run: RunFolder, held_out: HeldOut | None) -> list[Fact]:
    """What a run came to, most important first."""
    story, limit = run.story, run.story.trainings[-1].limit
    visits = many(len(story.visits), "visit", "visits")
    sweeps = many(len(story.sweeps), "full sweep", "full sweeps")
    rounds = f"{visits}, {sweeps}" if story.visits and story.blocks > 1 else ""
    seconds = story.seconds * max(len(story.workers), 1)  # layers' are summed over workers
    share = story.layer_seconds / seconds if seconds else 0.0
    return [
        *_quality(story, held_out),
        Fact("Gaussians", f"{story.gaussians:,}", more="" if limit is None else f"limit {limit:,}"),
        *_shed_at_end(story),
        *_parameters(run),
        Fact("blocks", f"{story.blocks:,}", more=rounds),
        Fact("steps", f"{story.step:,}"),
        Fact(
            "training time",
            f"{story.seconds:.1f} s" if story.seconds < 100 else clock(story.seconds),
            more=f"{share:.0%} for layers" if story.layer_seconds else "",
        ),
        *_workers(story),
        *_memory(run),
    ]


def _shed_at_end(story: Story) -> list[Fact]:
    if (shed := story.shed_at_end) is None:
        return []
    share = shed.gone / max(shed.gone + shed.gaussians, 1)
    views = many(shed.views, "training view", "training views")
    cost = f"{share:.0%}, for {shed.before - shed.after:.2f} dB of {views}"
    return [Fact("shed at the end", f"{shed.gone:,}", more=cost)]


def _parameters(run: RunFolder) -> list[Fact]:
    count = sum(run.parameters.values())
    if not count or run.checkpoint is None:
        return []
    each, nbytes = count / max(len(run.checkpoint.means), 1), FLOAT * count
    return [Fact("parameters", f"{count:,}", more=f"{each:.1f} a Gaussian, {nbytes / MIB:.1f} MiB")]


def _workers(story: Story) -> list[Fact]:
    if not story.workers:
        return []
    deaths = sum(worker.deaths for worker in story.workers)
    waited = sum(worker.waited for worker in story.workers) / len(story.workers)
    lost = f", {deaths} lost" if deaths else ""
    return [Fact("workers", f"{len(story.workers)}", more=f"waited {waited:.0%} of the time{lost}")]


def _quality(story: Story, held_out: HeldOut | None) -> list[Fact]:
    composited = held_out is not None and story.blocks > 1
    found = held_out and held_out.mean("psnr_merged"), held_out and held_out.mean("ssim_merged")
    if held_out is None and story.held_out:
        found = story.held_out[-1].psnr, story.held_out[-1].ssim
    facts = []
    for name, field, unit, digits, value in (
        ("held-out PSNR", "psnr", "dB", 2, found[0]),
        ("held-out SSIM", "ssim", "", 3, found[1]),
    ):
        also = held_out.mean(field) if composited else None
        more = "" if also is None else f"composited {also:.{digits}f}"
        facts.append(Fact(name, NOTHING if value is None else f"{value:.{digits}f}", unit, more))
    if composited:
        number, _, unit = held_out.gap.partition(" ")  # or the reason why there is none
        known = (number, unit, "merged against composited") if unit == "dB" else (NOTHING, "", held_out.gap)
        facts.append(Fact("ordering gap", *known))
    return facts


def _memory(run: RunFolder) -> list[Fact]:
    story, machine = run.story, run.settings.machine
    ram = max((line.rss_bytes for line in story.samples), default=0)
    device = max((line.device_bytes or 0 for line in story.samples), default=0)
    if story.end is not None:  # of the last process; after a resume an earlier one may have had more
        ram, device = max(ram, story.end.peak_rss_bytes), max(device, story.end.peak_device_bytes or 0)
    facts = [Fact("peak RAM", f"{ram / GIB:.2f}", "GiB", f"of {machine.ram_bytes / GIB:.0f} GiB")]
    if machine.gpu is not None:
        facts.append(Fact("peak GPU memory", f"{device / GIB:.2f}", "GiB", machine.gpu))
    return facts
