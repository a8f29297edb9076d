"""The scene of `abcd demo`: pictures of the court as a COLMAP data set, drawn by a ray caster."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import torch
from PIL import Image
from rich.console import Console

from abcd_ns.lab.world.court import build_world, court_cameras, stream
from abcd_ns.lab.world.sparse_points import court_points, write_model
from abcd_ns.progress_bar import ProgressBar

SOURCE = "SOURCE.md"
"""Is written last, so that a folder with it is whole."""


def draw_court(out: Path, views: int, size: tuple[int, int], points: int, supersample: int = 2) -> None:
    """Draw the court into `out`: images/, sparse/0/ and SOURCE.md. The same arguments give the same bytes.

    Args:
        size: width and height of the pictures, px.
        points: wanted number of sparse points; fewer where views overlap little.
        supersample: rays per pixel along each axis.
    """
    world, cameras = build_world(0), court_cameras(0, views, size)
    names = [f"view{k:03d}.png" for k in range(views)]
    (out / "images").mkdir(parents=True, exist_ok=True)

    def draw(k: int) -> None:
        picture = (255 * world.photo(cameras[k], supersample)).round().byte().numpy()
        Image.fromarray(picture).save(out / "images" / names[k], optimize=False)

    with ProgressBar("Drawing", views, Console(stderr=True)) as bar, _a_view_on_each_core() as pool:
        for _ in pool.map(draw, range(views)):
            bar.advance()
        found = court_points(world, cameras, points, stream(0, "points", 0))
    write_model(out / "sparse" / "0", dict(zip(names, cameras, strict=True)), found)
    (out / SOURCE).write_text(_source(views, len(found.xyz)), encoding="utf-8")


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


def _source(pictures: int, points: int) -> str:
    return f"""# Source

{pictures} pictures of a procedural scene, a walled court, drawn by ray casting, and a COLMAP model in
`sparse/0` with {points} points whose observations are exact projections.

- Made by `abcd demo` of abcd-ns.
- No photograph, scan or other data set went into it.
- Licence: Apache-2.0.
"""
