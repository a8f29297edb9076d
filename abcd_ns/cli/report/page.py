"""The page of `abcd report`: what a run came to and how it was set, in numbers, tables and pictures."""

import base64
import hashlib
import shlex
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from nerfstudio.cameras.cameras import Cameras

from abcd_ns import __version__
from abcd_ns.cli.report import GENERATOR, charts
from abcd_ns.cli.report.held_out import HeldOut
from abcd_ns.cli.report.run_folder import RunFolder, registered_config
from abcd_ns.data.input_errors import one_line
from abcd_ns.engine.train.run_state import BlockHealth, standing
from abcd_ns.errors import UserError
from abcd_ns.lab.compare.pictures import ERROR_GAIN
from abcd_ns.lab.results.tables import NOTHING, about_machine
from abcd_ns.machine import without_home
from abcd_ns.nerfstudio.datamanager import OUR_READER
from abcd_ns.nerfstudio.options import MIRRORED, mirror
from abcd_ns.nerfstudio.run import log_lines
from abcd_ns.nerfstudio.run.settings import Plain, Settings, flat_options
from abcd_ns.terminal import many
from abcd_ns.units import GIB
from abcd_ns.viewer.texts import clock

HERE = Path(__file__).parent
BLOCK_TITLES = ("block", "Gaussians", "pruned", "views", "visits", "time", "layers", "PSNR", "state")
"""Columns of `block_rows`. PSNR is that of training crops, after the first visit and after the last."""
READER = "pipeline.datamanager.dataparser."
OF_THE_PLACE = {
    *("data", "experiment_name", "load_checkpoint", "load_config", "load_dir", "load_step", "output_dir"),
    *("machine.device_type", "pipeline.datamanager.data", f"{READER}data", "timestamp"),
}
"""Options that say where a run was made and kept, not how it was trained."""
TAKEN_OVER = {"pipeline.training.seed", *(f"pipeline.model.{name}" for name in MIRRORED)}
"""Options that follow others."""
NO_FLAGS = ("pipeline.training.recipe.", "pipeline.training.limits.")
"""Prefixes of what is no option of `ns-train`: the method sets it, or the device's memory."""


def notes_of(run: RunFolder, data: Path | None) -> list[str]:
    """What the reader of the page must know first."""
    notes, version = [], run.settings.versions.abcd_ns
    if version != __version__:
        notes.append(f"The run is of abcd_ns {one_line(version)}; the defaults are those of {__version__}.")
    if run.checkpoint is None:
        return [*notes, "There is no checkpoint yet, and so no held-out views and no map."]
    if run.checkpoint.step < run.story.end.step:
        notes.append(
            f"Pictures and blocks are those of the checkpoint at step {run.checkpoint.step:,}; the log "
            f"goes on to step {run.story.end.step:,}."
        )
    if data is None:
        given = one_line(shlex.quote(run.settings.data_path))
        notes.append(f"Held-out views and their photos are shown if their folder is named: --data {given}")
    return notes


def render_page(
    run: RunFolder, held_out: HeldOut | None, cameras: Sequence[Cameras] = (), notes: Sequence[str] = ()
) -> str:
    """The whole page. Every text in it is escaped by the template; its script is the only one that may run.

    `held_out` is None where those views could not be drawn. `cameras` are those trained on, and those held
    out; none where the data is gone. `notes` are what the reader must know first.
    """
    settings, story, checkpoint = run.settings, run.story, run.checkpoint
    begun = [line.step for line in story.of(log_lines.TrainingLine)]
    unfinished = [f"resumed at step {step:,}" for step in begun if step > 0]
    unfinished += [] if story.last(log_lines.EndLine) else ["not ended: still running, or interrupted"]
    psnr = held_out and held_out.mean("psnr_merged")
    views = held_out.shown if held_out else ()
    versions = vars(settings.versions) | {"machine": about_machine(settings.machine)}
    css, script = ((HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    pages = Environment(loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined)
    return pages.get_template("page.html").render(
        generator=f"{GENERATOR} {__version__}",
        css=Markup(css),
        script=Markup(script),
        # As a Content-Security-Policy names the one script that may run.
        script_hash="sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        settings=settings,
        unfinished=unfinished,
        tiles=tiles(run, held_out),
        notes=[without_home(note) for note in notes],
        quality=charts.draw_quality(story, psnr and (checkpoint.step, psnr), settings.method),
        progress=charts.draw_progress(story),
        first=views[(len(views) - 1) // 2] if views else None,
        views=views,
        held_out=held_out,
        error_limit=f"{100 / ERROR_GAIN:g}%",
        map=charts.draw_map(checkpoint, cameras) if checkpoint and len(checkpoint.means) else None,
        figures=more_figures(run, held_out).items(),
        block_titles=BLOCK_TITLES,
        blocks=block_rows(run),
        changed=changed_options(settings),
        options=[(name, as_text(value)) for name, value in sorted(settings.options.items())],
        command=without_home(training_command(settings)),
        versions=[(name, value or NOTHING) for name, value in versions.items()],
    )


def tiles(run: RunFolder, held_out: HeldOut | None) -> list[tuple[str, str, str]]:
    """The four most important numbers of a run: name, value, and a line of small print."""
    story, limit, machine = run.story, run.story.last(log_lines.TrainingLine).limit, run.settings.machine
    if held_out is not None:
        psnr, ssim = held_out.mean("psnr_merged"), held_out.mean("ssim_merged")
    else:  # the log's last
        psnr, ssim = (story.held_out[-1].psnr, story.held_out[-1].ssim) if story.held_out else (None, None)
    share = log_lines.layer_share(story.visits)
    layers = f", {share:.0%} of the time for layers" if share else ""
    taken = f"{story.end.seconds:.1f} s" if story.end.seconds < 60 else clock(story.end.seconds)
    ram, device = _peaks(run)
    of = f"of {machine.ram_bytes / GIB:.0f} GiB"
    memory = ("peak RAM", ram, of)
    if machine.gpu is not None:
        memory = ("peak GPU memory", device, f"{machine.gpu}; RAM {ram} {of}")
    return [
        ("held-out PSNR", known(psnr, "{:.2f} dB"), f"SSIM {known(ssim, '{:.3f}')}"),
        ("Gaussians", f"{story.gaussians:,}", "" if limit is None else f"limit {limit:,}"),
        ("training time", taken, f"{story.end.step:,} steps{layers}"),
        memory,
    ]


def more_figures(run: RunFolder, held_out: HeldOut | None) -> dict[str, str]:
    """All other numbers, by name."""
    story, workers = run.story, run.story.of(log_lines.WorkerLine)
    found = {"blocks": f"{story.blocks:,}"}
    if held_out is not None and story.blocks > 1:
        psnr, ssim = known(held_out.mean("psnr"), "{:.2f} dB"), known(held_out.mean("ssim"), "{:.3f}")
        found |= {"composited": f"PSNR {psnr}, SSIM {ssim}", "ordering gap": held_out.gap}
    if held_out is not None and held_out.fog:
        mean, most = sum(held_out.fog) / len(held_out.fog), max(held_out.fog)
        found["fog"] = f"{mean:.1%} of the screen, {most:.1%} at most: Gaussians before the nearest point"
    if story.visits and story.blocks > 1:
        passes = many(len(story.of(log_lines.EpochEndLine)), "pass", "passes")
        found["visits"] = f"{len(story.visits):,}, {passes} over all blocks"
    if (pruned := story.last(log_lines.PrunedAtEndLine)) is not None:
        cost, views = pruned.before - pruned.after, many(pruned.views, "training view", "training views")
        share = pruned.gone / max(pruned.gone + pruned.gaussians, 1)
        found["pruned at the end"] = f"{pruned.gone:,} ({share:.0%}), costs {cost:.2f} dB on {views}"
    if workers:
        waited = sum(worker.waited for worker in workers) / len(workers)
        deaths = sum(worker.deaths for worker in workers)
        found["workers"] = f"{len(workers)}, waited {waited:.0%} of the time, {deaths} lost"
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
    seconds = sum(visit.visit_seconds for visit in visits)
    psnrs = [f"{visit.psnr:.2f}" for visit in visits if visit.psnr is not None]
    return (
        str(block + 1),
        known(gaussians),
        known(health[block].pruned if block in health else None),
        known(run.state.views.get(block)),
        str(len(visits)),
        known(seconds or None, "{:.1f} s"),
        known(log_lines.layer_share(visits) if visits else None, "{:.0%}"),
        f"{' to '.join(dict.fromkeys([psnrs[0], psnrs[-1]]))} dB" if psnrs else NOTHING,
        _state(run, block),
    )


def _state(run: RunFolder, block: int) -> str:
    """As the terminal tells it at the end of a run."""
    active = run.state.active
    if not run.story.of(log_lines.VisitLine):
        return "trained in every step"
    if active is not None and active.geometry.block == block:
        return "in training when saved"
    record = run.state.health.get(block) or BlockHealth(visits=len(run.story.of_block(block)))
    return standing(block, record, run.state.views)


def _peaks(run: RunFolder) -> tuple[str, str]:
    """Of RAM and of GPU memory: samples too, as the end tells of the last process only."""
    lines, end = run.story.of(log_lines.SampleLine), run.story.last(log_lines.EndLine)
    ram = [line.rss_bytes for line in lines] + ([end.peak_rss_bytes] if end else [])
    device = [line.device_bytes for line in lines] + ([end.peak_device_bytes] if end else [])
    ram, device = (max((nbytes or 0 for nbytes in found), default=0) for found in (ram, device))
    return f"{ram / GIB:.2f} GiB", f"{device / GIB:.2f} GiB"


def known(value: float | None, form: str = "{:,}") -> str:
    """A number in this form, where there is one."""
    return NOTHING if value is None else form.format(value)


def changed_options(settings: Settings) -> list[tuple[str, str, str]]:
    """Name, value and default of options that differ from the defaults; none of an unknown method."""
    try:
        config = registered_config(settings)
    except UserError:
        return []
    mirror(config.pipeline.training, config.pipeline.model)
    defaults, passed_over = flat_options(config), OF_THE_PLACE | TAKEN_OVER
    return [
        (name, as_text(value), as_text(defaults.get(name)))
        for name, value in settings.options.items()
        if name not in passed_over and (name not in defaults or defaults[name] != value)
    ]


def training_command(settings: Settings) -> str:
    """The command line that trains the run again, an option a line."""
    words, of_reader = [["ns-train", settings.method, "--data", settings.data]], []
    for name, value, _ in changed_options(settings):
        if settings.reader != OUR_READER and name.startswith(READER):
            # Options of another reader of data stand after its name, without a prefix.
            of_reader.append([_flag(name.removeprefix(READER)), value])
        elif not name.startswith(NO_FLAGS):
            words.append([_flag(name), value])
    if settings.reader != OUR_READER:
        words += [[settings.reader], *of_reader]
    return " \\\n  ".join(map(shlex.join, words))


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def as_text(value: Plain) -> str:
    """A value as it stands on a command line, without the name of anyone's home."""
    return without_home(str(value))
