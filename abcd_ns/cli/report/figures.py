"""What a run came to, in numbers and tables."""

from abcd_ns.cli.report.held_out import HeldOut
from abcd_ns.cli.report.run_folder import RunFolder
from abcd_ns.cli.report.story import Story
from abcd_ns.cli.terminal import many
from abcd_ns.engine.train.memory import FLOAT
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.lab.results.tables import NOTHING
from abcd_ns.units import GIB, MIB
from abcd_ns.viewer.texts import clock

BLOCK_TITLES = ("block", "Gaussians", "pruned", "views", "visits", "time", "layers", "PSNR", "state")
"""Columns of `block_rows`. PSNR is that of training crops, after the first visit and after the last."""
Tile = tuple[str, str, str]
"""A name, its value, and a line of small print."""


def tiles(run: RunFolder, held_out: HeldOut | None) -> list[Tile]:
    """The four most important numbers of a run."""
    story, limit = run.story, run.story.trainings[-1].limit
    psnr, ssim = _scores(story, held_out)
    layers = f", {story.layer_share:.0%} of it for layers" if story.layer_share else ""
    ram, device = _peaks(run)
    of = f"of {run.settings.machine.ram_bytes / GIB:.0f} GiB"
    gpu = run.settings.machine.gpu
    memory = ("peak RAM", ram, of) if gpu is None else ("peak GPU memory", device, f"{gpu}; RAM {ram} {of}")
    return [
        ("held-out PSNR", known(psnr, "{:.2f} dB"), f"SSIM {known(ssim, '{:.3f}')}"),
        ("Gaussians", f"{story.gaussians:,}", "" if limit is None else f"limit {limit:,}"),
        (
            "training time",
            f"{story.seconds:.1f} s" if story.seconds < 100 else clock(story.seconds),
            f"{story.step:,} steps{layers}",
        ),
        memory,
    ]


def more_figures(run: RunFolder, held_out: HeldOut | None) -> dict[str, str]:
    """All other numbers, by name."""
    story = run.story
    found = {"blocks": f"{story.blocks:,}"}
    if held_out is not None and story.blocks > 1:
        psnr, ssim = known(held_out.mean("psnr"), "{:.2f} dB"), known(held_out.mean("ssim"), "{:.3f}")
        found |= {"composited": f"PSNR {psnr}, SSIM {ssim}", "ordering gap": held_out.gap}
    if story.visits and story.blocks > 1:
        found["visits"] = f"{len(story.visits)}, {len(story.sweeps)} passes over all blocks"
    if (pruned := story.shed_at_end) is not None:
        cost, views = pruned.before - pruned.after, many(pruned.views, "training view", "training views")
        share = pruned.gone / max(pruned.gone + pruned.gaussians, 1)
        found["pruned at the end"] = f"{pruned.gone:,} ({share:.0%}), costs {cost:.2f} dB on {views}"
    if run.parameters and run.checkpoint is not None:
        each = run.parameters / max(len(run.checkpoint.means), 1)
        size = f"{FLOAT * run.parameters / MIB:.1f} MiB"
        found["parameters"] = f"{run.parameters:,}, {each:.1f} a Gaussian, {size}"
    if story.workers:
        waited = sum(worker.waited for worker in story.workers) / len(story.workers)
        deaths = sum(worker.deaths for worker in story.workers)
        found["workers"] = f"{len(story.workers)}, waited {waited:.0%} of the time, {deaths} lost"
    return found


def block_rows(run: RunFolder) -> list[tuple[str, ...]]:
    """A row for each block, under BLOCK_TITLES."""
    counts = []
    if run.checkpoint is not None:
        tree = run.checkpoint.tree
        counts = tree.assign(run.checkpoint.means).bincount(minlength=tree.num_blocks).tolist()
    counts += [None] * (run.story.blocks - len(counts))  # cut off since the checkpoint, or there is none
    return [_block_row(run, block, count) for block, count in enumerate(counts)]


def _block_row(run: RunFolder, block: int, gaussians: int | None) -> tuple[str, ...]:
    visits, health = run.story.of_block(block), run.state.health
    seconds = sum(visit.seconds for visit in visits)
    layers = sum(visit.layer_seconds for visit in visits)
    psnrs = [f"{visit.psnr:.2f}" for visit in visits if visit.psnr is not None]
    return (
        str(block + 1),
        known(gaussians),
        known(health[block].shed if block in health else None),
        known(run.state.views.get(block)),
        str(sum(visit.done for visit in visits)),
        known(seconds or None, "{:.1f} s"),
        known(layers / seconds if seconds else None, "{:.0%}"),
        f"{' to '.join(dict.fromkeys([psnrs[0], psnrs[-1]]))} dB" if psnrs else NOTHING,
        _state(run.story, run.state, block, gaussians),
    )


def _state(story: Story, state: RunState, block: int, gaussians: int | None) -> str:
    if not story.visits:
        return "trained in every step"
    if state.active is not None and state.active.geometry.block == block:
        return "in training when saved"
    if gaussians == 0:
        return "empty"
    if any(visit.done for visit in story.of_block(block)):
        return "trained"
    if state.views.get(block) == 0:
        return "no view shows it"
    return "in the warm-up only" if any(visit.block is None for visit in story.visits) else "not yet visited"


def _scores(story: Story, held_out: HeldOut | None) -> tuple[float | None, float | None]:
    """Held-out PSNR and SSIM: measured for the report, or else the log's last."""
    if held_out is not None:
        return held_out.mean("psnr_merged"), held_out.mean("ssim_merged")
    return (story.held_out[-1].psnr, story.held_out[-1].ssim) if story.held_out else (None, None)


def _peaks(run: RunFolder) -> tuple[str, str]:
    """Of RAM and of GPU memory."""
    lines, end = run.story.samples, run.story.end
    ram = max((line.rss_bytes for line in lines), default=0)
    device = max((line.device_bytes or 0 for line in lines), default=0)
    if end is not None:  # of the last process; after a resume an earlier one may have had more
        ram, device = max(ram, end.peak_rss_bytes), max(device, end.peak_device_bytes or 0)
    return f"{ram / GIB:.2f} GiB", f"{device / GIB:.2f} GiB"


def known(value: float | None, form: str = "{:,}") -> str:
    """A number in this form, where there is one."""
    return NOTHING if value is None else form.format(value)
