"""Streamed SOG, version 1: a folder of .sog files by place and level of detail.

The format is described at developer.playcanvas.com, "The Streamed SOG Format".
"""

import io
import json
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch

from abcd_ns.engine.types import Gaussians
from abcd_ns.formats.levels import coarser
from abcd_ns.formats.packed import MOST_SOG, packed
from abcd_ns.formats.ply import GENERATOR

LEVELS = 5  # each has half as many Gaussians as the one before


def write_streamed(folder: Path, parts: Iterable[Gaussians], antialiased: bool = False) -> list[Path]:
    """Write `parts`, one after the other, into a folder; returns its files: lod-meta.json, and by leaf and
    level an unpacked .sog.

    RAM holds one part. Parts that follow each other should be near each other: the tree joins them in order.
    """
    leaves, files, counts = [], [], [0] * LEVELS
    for gaussians in (leaf for part in parts for leaf in _leaves(part)):
        reach = gaussians.scales.exp().amax(dim=1, keepdim=True)
        bound = {
            "min": (gaussians.means - reach).amin(dim=0).tolist(),
            "max": (gaussians.means + reach).amax(dim=0).tolist(),
        }
        lods = {}
        for level in range(LEVELS):
            name = f"{level}_{len(leaves)}"
            sog = packed(len(gaussians), gaussians.sh_degree, "sog", [gaussians], antialiased)
            zipfile.ZipFile(io.BytesIO(sog)).extractall(folder / name)
            lods[str(level)] = {"file": len(files), "offset": 0, "count": len(gaussians)}
            files.append(f"{name}/meta.json")
            counts[level] += len(gaussians)
            gaussians = coarser(gaussians)
        leaves.append({"bound": bound, "lods": lods})
    meta = {
        "version": 1,
        "asset": {"generator": GENERATOR},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": LEVELS,
        "filenames": files,
        "tree": _tree(leaves),
    }
    index = folder / "lod-meta.json"
    index.write_text(json.dumps(meta))
    return [index, *(path for name in files for path in (folder / name).parent.iterdir())]


def _leaves(gaussians: Gaussians) -> Iterator[Gaussians]:
    if len(gaussians) <= MOST_SOG:
        yield gaussians
        return
    means = gaussians.means
    order = means[:, (means.amax(dim=0) - means.amin(dim=0)).argmax()].argsort()
    for half in order.chunk(2):
        yield from _leaves(gaussians[half])


def _tree(nodes: list[dict[str, Any]]) -> dict[str, Any]:
    """A balanced binary tree of nodes; each holds the bounds of what is below it."""
    if len(nodes) == 1:
        return nodes[0]
    children = [_tree(nodes[: len(nodes) // 2]), _tree(nodes[len(nodes) // 2 :])]
    corners = {end: torch.tensor([child["bound"][end] for child in children]) for end in ("min", "max")}
    bound = {"min": corners["min"].amin(dim=0).tolist(), "max": corners["max"].amax(dim=0).tolist()}
    return {"bound": bound, "children": children}
