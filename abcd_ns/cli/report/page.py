"""The report's page: what is known of a run, put into page.html."""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from abcd_ns import __version__
from abcd_ns.cli.report import charts
from abcd_ns.cli.report.blocks import describe_blocks
from abcd_ns.cli.report.headline import headline
from abcd_ns.cli.report.held_out import HeldOut
from abcd_ns.cli.report.options import as_text, changed_options, training_command
from abcd_ns.cli.report.plan import Plan, draw_plan
from abcd_ns.cli.report.run_folder import RunFolder
from abcd_ns.cli.report.story import Story
from abcd_ns.cli.report.svg import inline_svg, theme_css
from abcd_ns.lab.compare.pictures import ERROR_COLORS, ERROR_GAIN
from abcd_ns.lab.results.tables import NOTHING, about_machine
from abcd_ns.machine import Versions, without_home

GENERATOR = "abcd report"
"""Begins the page's generator, by which a page of ours is known."""
HERE = Path(__file__).parent
CAPTIONS = {
    "Quality": "PSNR of the held-out views, and of the crops that were trained on.",
    "Visits": (
        "Which block was trained when; each visit begins with drawing its layers. Dotted: a sweep ends."
    ),
    "Gaussians": "In the whole scene.",
    "Quality by block": "On training crops, at the end of each visit.",
    "Memory": "Of the process.",
    "Budgets": "What is kept at hand, as a share of what may be.",
}
SPARK_WIDTH, SPARK_HEIGHT, SPARK_EDGE = 112, 22, 3
SPARK_DB = 1.0
"""The height of a sparkline stands for at least so much, that noise may look small."""


@dataclass(frozen=True)
class Chart:
    """A chart with its caption."""

    title: str
    text: str
    svg: Markup


def render_page(run: RunFolder, held_out: HeldOut | None, plan: Plan | None, notes: Sequence[str]) -> str:
    """The whole page. Every text in it is escaped by the template; its script is the only one that may run.

    Args:
        held_out: None where the held-out views could not be drawn.
        plan: None where there is no checkpoint.
        notes: what the reader must know before all else.
    """
    settings, story = run.settings, run.story
    script = (HERE / "page.js").read_text(encoding="utf-8")
    pages = Environment(loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined)
    pages.filters |= {"known": _known, "spark": sparkline}
    return pages.get_template("page.html").render(
        generator=f"{GENERATOR} {__version__}",
        script=Markup(script),
        # As a Content-Security-Policy names the one script that may run.
        script_hash="sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        css=Markup((HERE / "page.css").read_text(encoding="utf-8")),
        dark_charts=Markup(theme_css()),
        scene=settings.scene,
        method=settings.method,
        begun=f"{settings.begun:%Y-%m-%d %H:%M} UTC",
        unfinished=_unfinished(story),
        headline=headline(run, held_out),
        notes=[without_home(note) for note in notes],
        charts=_charts(run, held_out),
        views=[] if held_out is None else held_out.shown,
        view_count=0 if held_out is None else len(held_out.scores),
        error_colors=", ".join(to_hex(matplotlib.colormaps[ERROR_COLORS](k / 8)) for k in range(9)),
        error_limit=f"{100 / ERROR_GAIN:g}%",
        plans=_plans(plan),
        blocks=describe_blocks(run),
        changed=changed_options(settings),
        options=[(name, as_text(value)) for name, value in sorted(settings.options.items())],
        command=without_home(training_command(settings)),
        machine=about_machine(settings.machine),
        versions=_versions(settings.versions),
    )


def _versions(versions: Versions) -> list[tuple[str, str]]:
    commit, plus, changes = (versions.commit or NOTHING).partition("+")
    known = {**vars(versions), "commit": commit[:12] + plus + changes}
    return [(name, value or NOTHING) for name, value in known.items()]


def _unfinished(story: Story) -> list[str]:
    resumed = [f"resumed at step {line.step:,}" for line in story.trainings if line.step > 0]
    return resumed if story.end is not None else [*resumed, "not ended: still running, or broken off"]


# -- charts ------------------------------------------------------------------------------------------


def _charts(run: RunFolder, held_out: HeldOut | None) -> list[Chart]:
    story, method = run.story, run.settings.method
    psnr = None if held_out is None else held_out.mean("psnr_merged")
    measured = None if psnr is None or run.checkpoint is None else (run.checkpoint.step, psnr)
    figures = {
        "Quality": charts.draw_quality(story, measured, method),
        "Visits": charts.draw_visits(story),
        "Gaussians": charts.draw_gaussians(story),
        "Quality by block": charts.draw_block_quality(story),
        "Memory": charts.draw_memory(story),
        "Budgets": charts.draw_budgets(story),
    }
    titles = charts.visit_titles(story)
    return [_chart(title, CAPTIONS[title], figure, titles) for title, figure in figures.items() if figure]


def _plans(plan: Plan | None) -> list[Chart]:
    if plan is None or not len(plan.means):
        return []
    text = "Cells, Gaussians (grey)" + (", cameras (orange: held out)." if len(plan.cameras) else ".")
    drawn = [_chart("From above", text, draw_plan(plan))]
    if plan.is_stacked:
        drawn.append(_chart("From the side", "Where cells lie above others.", draw_plan(plan, 0, 2)))
    return drawn


def _chart(title: str, text: str, figure: Figure, titles: Mapping[str, str] | None = None) -> Chart:
    name = title.lower().replace(" ", "-")
    return Chart(title, text, Markup(inline_svg(figure, name, f"Chart: {title}. {text}", titles or {})))


# -- what the template writes with -------------------------------------------------------------------


def _known(value: float | None, form: str = "{:,}") -> str:
    """A number in this form, where there is one."""
    return NOTHING if value is None else form.format(value)


def sparkline(values: Sequence[float]) -> Markup:
    """A line through the values, as large as a word; nothing without values."""
    if not values:
        return Markup("")
    middle, span = (min(values) + max(values)) / 2, max(max(values) - min(values), SPARK_DB)
    across = (SPARK_WIDTH - 2 * SPARK_EDGE) / max(len(values) - 1, 1)
    along = (SPARK_HEIGHT - 2 * SPARK_EDGE) / span
    places = [
        (SPARK_EDGE + k * across, SPARK_HEIGHT / 2 - (y - middle) * along) for k, y in enumerate(values)
    ]
    points, (x, y) = " ".join(f"{x:.1f},{y:.1f}" for x, y in places), places[-1]
    return Markup(  # of numbers alone: there is nothing to escape
        f'<svg class="spark" viewBox="0 0 {SPARK_WIDTH} {SPARK_HEIGHT}" role="img" '
        f'aria-label="from {values[0]:.1f} to {values[-1]:.1f} dB">'
        f'<polyline points="{points}"/><circle cx="{x:.1f}" cy="{y:.1f}" r="2.5"/></svg>'
    )
