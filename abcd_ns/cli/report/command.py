"""`abcd report`: one training run as one HTML page that needs nothing else."""

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from abcd_ns.arguments import check_ranges
from abcd_ns.cli.paths import check_file, find_run
from abcd_ns.cli.report import GENERATOR
from abcd_ns.errors import UserError
from abcd_ns.run import SETTINGS_FILE
from abcd_ns.terminal import print_plain
from abcd_ns.units import bytes_in_words


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
    # These load nerfstudio, in seconds.
    from abcd_ns.cli.report.held_out import look_at_held_out
    from abcd_ns.cli.report.page import notes_of, render_page
    from abcd_ns.cli.report.run_folder import load_pipeline, open_run

    console, found = Console(), open_run(folder)
    held_out, cameras, notes = None, [], notes_of(found, data)
    if data is not None and found.checkpoint is not None:
        try:
            pipeline = load_pipeline(found, data)
            cameras = [pipeline.datamanager.train_dataset.cameras, pipeline.datamanager.eval_dataset.cameras]
            held_out = look_at_held_out(pipeline, pictures)
        except UserError as error:  # photos may go missing until they are read
            notes.append(f"Held-out views could not be drawn. {error}")
    # A file's name may have bytes that are no text.
    out.write_text(render_page(found, held_out, cameras, notes), "utf-8", "backslashreplace")
    for note in notes:
        print_plain(note, console, "yellow")
    print_plain(f"{out} ({bytes_in_words(out.stat().st_size)})", console)
    return 0
