"""`abcd synth OUT`: draw a scene of walled courts into a COLMAP data set."""

import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from PIL import Image
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.results.records import read_json, write_json
from abcd_ns.lab.runs.runner import say, take_folder, taking
from abcd_ns.lab.synth.sparse_points import SparsePoints, court_points, write_model
from abcd_ns.lab.world.court import Layout, Site, build_world, court_cameras
from abcd_ns.progress_bar import ProgressBar

FORMAT = 4
"""Raised whenever the same settings would draw another scene."""
MARKER = "synth.json"
LIMITS = {
    "courts": (1, 10_000),
    "views_per_court": (2, 10_000),
    "width": (16, 8192),
    "height": (16, 8192),
    "seed": (0, 2**31 - 1),
    "points_per_court": (1, 10_000_000),
    "supersample": (1, 8),
}
"""The least and the most that each may be."""


@dataclass(frozen=True)
class Settings:
    """All that decides what is drawn."""

    courts: int = 2
    """Number of courts."""
    layout: Layout = "grid"
    """Courts in a near-square grid or in one row."""
    views_per_court: int = 24
    """Pictures taken of each court."""
    width: int = 320
    """Of the pictures, in pixels."""
    height: int = 240
    """Of the pictures, in pixels."""
    seed: int = 0
    """Chooses colours, objects, openings, sun and camera poses."""
    points_per_court: int = 4000
    """Sparse points to write per court, fewer where views overlap little."""
    supersample: int = 2
    """Rays per pixel along each axis."""

    def check(self) -> None:
        """Raise a UserError if one is out of range."""
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            if not low <= value <= high:
                flag = "--" + name.replace("_", "-")
                raise UserError(f"{flag} is {value}; it must lie between {low} and {high}.")

    @property
    def command(self) -> str:
        """The command line that draws the same scene."""
        flags = [f"--{name.replace('_', '-')} {value}" for name, value in asdict(self).items()]
        return "abcd synth OUT " + " ".join(flags)


@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def synth(
    out: Annotated[Path, tyro.conf.Positional],
    settings: Annotated[Settings, tyro.conf.arg(name="")],
    overwrite: bool = False,
) -> None:
    """Draw a scene of walled courts side by side, as a COLMAP data set.

    The pictures come from a ray caster of their own, so they favour no method that is trained on them.
    The same settings give the same bytes.

    Args:
        out: Folder for images/, sparse/0/ and SOURCE.md; must be empty, absent or an earlier result.
        settings: All that decides what is drawn.
        overwrite: Replace an earlier result of this command that has other settings or is incomplete.

    Raises:
        UserError: a setting is out of range, or `out` holds something else or cannot be written.
    """
    settings.check()
    console, path = Console(stderr=True), out / MARKER
    marker = {"format": FORMAT, "complete": True, "settings": asdict(settings)}
    with taking(out):
        if take_folder(out, path, "scene of this command"):
            earlier = read_json(path)
            if earlier == marker:
                say(console, f"{out} already holds this scene; nothing to do.")
                return
            if not overwrite:
                state = "another scene" if earlier.get("complete") else "an unfinished scene"
                raise UserError(
                    f"{out} holds {state}; pass --overwrite to replace it, or name another folder."
                )
            for name in ("images", "sparse"):  # what this command writes; --overwrite removes no more
                shutil.rmtree(out / name, ignore_errors=True)
            (out / "SOURCE.md").unlink(missing_ok=True)
        write_json(path, {**marker, "complete": False})
    pictures, points = _draw(out, settings, console)
    (out / "SOURCE.md").write_text(_source(settings, pictures, points), encoding="utf-8")
    write_json(path, marker)
    say(console, f"{out}: {pictures} pictures and {points} points of {settings.courts} courts.")


def _draw(out: Path, settings: Settings, console: Console) -> tuple[int, int]:
    """Render and write everything, one court at a time; the numbers of pictures and points."""
    site = Site.plan(settings.courts, settings.layout, settings.seed)
    world, count, size = build_world(site), settings.views_per_court, (settings.width, settings.height)
    views = [view for k in range(settings.courts) for view in court_cameras(site, k, count, size)]
    names = [f"court{k // count:03d}_view{k % count:03d}.png" for k in range(len(views))]
    (out / "images").mkdir(exist_ok=True)
    parts: list[SparsePoints] = []

    def draw(k: int) -> None:
        picture = (255 * world.photo(views[k], settings.supersample)).round().byte().numpy()
        Image.fromarray(picture).save(out / "images" / names[k], optimize=False)

    with ProgressBar("Drawing", len(views), console) as bar, _a_view_on_each_core() as pool:
        for court in range(settings.courts):
            own = range(court * count, (court + 1) * count)
            for _ in pool.map(draw, own):
                bar.advance()
            around = sorted([court, *site.neighbors(court)])
            nearby = [c for k in around for c in range(k * count, (k + 1) * count)]
            rng = site.rng("points", court)
            parts.append(court_points(world, views, own, nearby, settings.points_per_court, rng))
    points = sum(len(part.xyz) for part in parts)
    if not points:
        raise UserError("No point is seen by two views; raise --views-per-court or --points-per-court.")
    write_model(out / "sparse" / "0", dict(zip(names, views, strict=True)), parts)
    return len(views), points


@contextmanager
def _a_view_on_each_core() -> Iterator[ThreadPoolExecutor]:
    """Threads that draw: rays are parted by what they meet, into rows too few for torch's own threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)


def _source(settings: Settings, pictures: int, points: int) -> str:
    return f"""# Source

{pictures} pictures of a procedural scene of {settings.courts} walled courts, drawn by ray casting,
and a COLMAP model in `sparse/0` with {points} points whose observations are exact projections.

- Made by `{settings.command}` (abcd-ns, scene format {FORMAT}); the same command draws the same bytes.
- Seed: {settings.seed}.
- No photograph, scan or other data set went into it.
- Licence: Apache-2.0.
"""
