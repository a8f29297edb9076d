"""The page of `abcd report`, of what the other files make."""

import base64
import hashlib
import shlex
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from nerfstudio.cameras.cameras import Cameras

from abcd_ns import __version__
from abcd_ns.cli.report import GENERATOR, charts, figures
from abcd_ns.cli.report.held_out import HeldOut
from abcd_ns.cli.report.run_folder import RunFolder
from abcd_ns.data.input_errors import one_line
from abcd_ns.lab.compare.pictures import ERROR_GAIN
from abcd_ns.lab.results.tables import NOTHING, about_machine
from abcd_ns.machine import without_home
from abcd_ns.nerfstudio.run.log_lines import EndLine, TrainingLine

HERE = Path(__file__).parent


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
    unfinished = [f"resumed at step {line.step:,}" for line in story.of(TrainingLine) if line.step > 0]
    unfinished += [] if story.last(EndLine) else ["not ended: still running, or interrupted"]
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
        tiles=figures.tiles(run, held_out),
        notes=[without_home(note) for note in notes],
        quality=charts.draw_quality(story, psnr and (checkpoint.step, psnr), settings.method),
        progress=charts.draw_progress(story),
        first=views[(len(views) - 1) // 2] if views else None,
        views=views,
        held_out=held_out,
        error_limit=f"{100 / ERROR_GAIN:g}%",
        map=charts.draw_map(checkpoint, cameras) if checkpoint and len(checkpoint.means) else None,
        figures=figures.more_figures(run, held_out).items(),
        block_titles=figures.BLOCK_TITLES,
        blocks=figures.block_rows(run),
        changed=figures.changed_options(settings),
        options=[(name, figures.as_text(value)) for name, value in sorted(settings.options.items())],
        command=without_home(figures.training_command(settings)),
        versions=[(name, value or NOTHING) for name, value in versions.items()],
    )
