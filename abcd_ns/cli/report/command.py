"""`abcd report`: one training run as one HTML page that needs nothing else."""

import base64
import hashlib
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from nerfstudio.cameras.cameras import Cameras
from rich.console import Console

from abcd_ns import __version__
from abcd_ns.arguments import check_ranges
from abcd_ns.cli.paths import check_file, find_run
from abcd_ns.cli.report import charts, figures
from abcd_ns.cli.report.held_out import HeldOut, look_at_held_out
from abcd_ns.cli.report.run_folder import RunFolder, load_pipeline, open_run
from abcd_ns.data.input_errors import one_line
from abcd_ns.errors import UserError
from abcd_ns.lab.compare.pictures import ERROR_GAIN
from abcd_ns.lab.results.tables import NOTHING, about_machine
from abcd_ns.machine import without_home
from abcd_ns.nerfstudio.run.log_lines import EndLine, TrainingLine
from abcd_ns.nerfstudio.run.settings import SETTINGS_FILE
from abcd_ns.terminal import print_plain
from abcd_ns.units import bytes_in_words

GENERATOR = "abcd report"  # begins the page's generator, by which a page of ours is known
HERE = Path(__file__).parent


def report(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    data: Annotated[Path | None, tyro.conf.arg(metavar="DIR", help_behavior_hint="")] = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None,
    pictures: Annotated[int, tyro.conf.arg(metavar="N")] = 3,
) -> int:
    """Write an HTML page about a training run: held-out views, quality, memory, visits, blocks, settings.

    abcd report outputs/garden/abcd/TIME --data garden

    The page is a single file and needs no network. With --data it shows renderings of the newest checkpoint
    over their photos.

    Args:
        run: Folder of the run, outputs/SCENE/METHOD/TIME.
        data: Folder of the run's photos, as given to `ns-train`. The path stored in the run is not followed.
            A run from elsewhere could name any folder, and the page would show its content.
        out: File of the page. Default: report.html in the run's folder.
        pictures: Number of held-out views to show, from the best to the worst.
    """
    check_ranges({"pictures": pictures})
    folder = find_run(run, SETTINGS_FILE)
    out = out or folder / "report.html"
    check_file("--out", out)
    if out.exists() and f'content="{GENERATOR} '.encode() not in out.read_bytes()[:2048]:
        raise UserError(f"--out {out} is no page of this command; name another file.")
    console, found = Console(), open_run(folder)
    held_out, cameras, notes = None, [], _notes(found, data)
    if data is not None and found.checkpoint is not None:
        try:
            pipeline = load_pipeline(found, data)
            sets = pipeline.datamanager.train_dataset, pipeline.datamanager.eval_dataset
            cameras = [each.cameras for each in sets]
            held_out = look_at_held_out(pipeline, pictures)
        except UserError as error:  # photos may go missing until they are read
            notes.append(f"Held-out views could not be drawn. {error}")
    # A file's name may have bytes that are no text.
    out.write_text(render_page(found, held_out, cameras, notes), "utf-8", "backslashreplace")
    for note in notes:
        print_plain(note, console, "yellow")
    print_plain(f"{out} ({bytes_in_words(out.stat().st_size)})", console)
    return 0


def _notes(run: RunFolder, data: Path | None) -> list[str]:
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
