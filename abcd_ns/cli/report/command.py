"""`abcd report`: one training run as one HTML page that needs nothing else."""

import shlex
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from abcd_ns import __version__
from abcd_ns.cli.paths import check_file, find_run
from abcd_ns.cli.report.held_out import look_at_held_out
from abcd_ns.cli.report.page import GENERATOR, render_page
from abcd_ns.cli.report.run_folder import RunFolder, load_pipeline, open_run
from abcd_ns.cli.terminal import print_plain
from abcd_ns.data.input_errors import one_line
from abcd_ns.errors import UserError
from abcd_ns.lab.runs.options import check_ranges
from abcd_ns.nerfstudio.run.settings import SETTINGS_FILE

PAGE_FILE = "report.html"


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
    out = folder / PAGE_FILE if out is None else out
    _check_page(out)
    console, found = Console(), open_run(folder)
    held_out, cameras, notes = None, [], _notes(found, data)
    if data is not None and found.checkpoint is not None:
        try:
            pipeline = load_pipeline(found, data)
            sets = pipeline.datamanager.train_dataset, pipeline.datamanager.eval_dataset
            cameras = [each.cameras for each in sets]
            held_out = look_at_held_out(pipeline, pictures, console)
        except UserError as error:  # photos may go missing until they are read
            notes.append(f"Held-out views could not be drawn. {error}")
    page = render_page(found, held_out, cameras, notes)
    out.write_text(page, "utf-8", "backslashreplace")  # a file's name may have bytes that are no text
    for note in notes:
        print_plain(note, console, "yellow")
    print_plain(f"{out} ({out.stat().st_size / 2**20:.1f} MiB)", console)
    return 0


def _check_page(out: Path) -> None:
    """Whether the page may be written there: over nothing, or an earlier page of this command."""
    check_file("--out", out)
    if out.exists() and f'content="{GENERATOR} '.encode() not in out.read_bytes()[:2048]:
        raise UserError(f"--out {out} is no page of this command; name another file.")


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
