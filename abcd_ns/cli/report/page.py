"""The report's page: what is known of a run, put into page.html."""

import base64
import hashlib
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from nerfstudio.cameras.cameras import Cameras

from abcd_ns import __version__
from abcd_ns.cli.report import charts
from abcd_ns.cli.report.figures import BLOCK_TITLES, block_rows, more_figures, tiles
from abcd_ns.cli.report.held_out import HeldOut
from abcd_ns.cli.report.options import as_text, changed_options, training_command
from abcd_ns.cli.report.run_folder import RunFolder
from abcd_ns.cli.report.story import Story
from abcd_ns.lab.compare.pictures import ERROR_GAIN
from abcd_ns.lab.results.tables import NOTHING, about_machine
from abcd_ns.machine import without_home
from abcd_ns.nerfstudio.run.log_lines import EndLine, TrainingLine

GENERATOR = "abcd report"
"""Begins the page's generator, by which a page of ours is known."""
HERE = Path(__file__).parent
SCRIPT = """
for (const slider of document.querySelectorAll(".slider")) {
  const range = slider.querySelector("input");
  const show = () => slider.style.setProperty("--at", range.value + "%");
  range.addEventListener("input", show);
  show();  // a browser that goes back to the page keeps the range's value
}
"""


def render_page(
    run: RunFolder, held_out: HeldOut | None, cameras: Sequence[Cameras] = (), notes: Sequence[str] = ()
) -> str:
    """The whole page. Every text in it is escaped by the template; its script is the only one that may run.

    Args:
        held_out: None where the held-out views could not be drawn.
        cameras: those trained on, and those held out; none where the data is gone.
        notes: what the reader must know first.
    """
    settings, story, checkpoint = run.settings, run.story, run.checkpoint
    psnr = held_out and held_out.mean("psnr_merged")
    views = held_out.shown if held_out else ()
    versions = vars(settings.versions) | {"machine": about_machine(settings.machine)}
    pages = Environment(loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined)
    return pages.get_template("page.html").render(
        generator=f"{GENERATOR} {__version__}",
        script=Markup(SCRIPT),
        # As a Content-Security-Policy names the one script that may run.
        script_hash="sha256-" + base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode(),
        css=Markup((HERE / "page.css").read_text(encoding="utf-8")),
        settings=settings,
        unfinished=_unfinished(story),
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


def _unfinished(story: Story) -> list[str]:
    resumed = [f"resumed at step {line.step:,}" for line in story.of(TrainingLine) if line.step > 0]
    return resumed if story.last(EndLine) else [*resumed, "not ended: still running, or interrupted"]
