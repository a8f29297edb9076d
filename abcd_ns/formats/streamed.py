"""Streamed SOG, version 1: a folder of .sog files by place and level of detail.

The format is described at developer.playcanvas.com, "The Streamed SOG Format". Levels are coarser copies of
the Gaussians, whose neighbours are merged by their moments.
"""

import io
import itertools
import json
import signal
import zipfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.packed import MOST_SOG, packed
from abcd_ns.formats.ply import GENERATOR, Content
from abcd_ns.machine import end_with_parent

Found = TypeVar("Found")

LEVELS = 5  # each has half as many Gaussians as the one before
NEIGHBOURS = 8  # with which a Gaussian may be merged
COLOR = 4.0  # of a difference in colour against one in place, when pairs are chosen
MOST_OPAQUE = 0.99
WIDER = 0.25
"""Of what would be more than opaque, as a power, how much makes a Gaussian wider. 1 keeps a wall as opaque
as it was, but blurs captures."""


def write_streamed(
    folder: Path, parts: Iterable[Gaussians], antialiased: bool = False, processes: int = 1
) -> list[Path]:
    """Write `parts`, one after the other, into a folder; returns its files: lod-meta.json, and by leaf and
    level an unpacked .sog.

    RAM holds one part, and some 330 MiB for each of several `processes`, which pack leaves. Parts that
    follow each other should be near each other: the tree joins them in order. Raises UserError.
    """
    leaves = (leaf for part in parts for leaf in _leaves(part))
    calls = ((folder, number, leaf, antialiased) for number, leaf in enumerate(leaves))
    nodes = list(_done(_write_leaf, calls, processes))
    counts = [sum(node["lods"][str(level)]["count"] for node in nodes) for level in range(LEVELS)]
    files = [f"{level}_{number}/meta.json" for number in range(len(nodes)) for level in range(LEVELS)]
    meta = {
        "version": 1,
        "asset": {"generator": GENERATOR},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": LEVELS,
        "filenames": files,
        "tree": _tree(nodes),
    }
    index = folder / "lod-meta.json"
    index.write_text(json.dumps(meta))
    return [index, *(path for name in files for path in (folder / name).parent.iterdir())]


def _done(function: Callable[..., Found], calls: Iterable[tuple], processes: int) -> Iterator[Found]:
    """What a function returns for each tuple of arguments, in their order. Few calls wait at a time."""
    if processes == 1:
        yield from itertools.starmap(function, calls)
        return
    waiting: deque[Future[Found]] = deque()
    try:
        # Processes, as gaussforge holds Python's lock.
        with ProcessPoolExecutor(processes, get_context("spawn"), _begin_process) as pool:
            for call in calls:
                waiting.append(pool.submit(function, *call))
                if len(waiting) > processes:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
    except BrokenProcessPool:
        raise UserError("A process that packs was killed: free memory, and export again.") from None


def _begin_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that waits
    end_with_parent()
    torch.set_num_threads(1)


def _write_leaf(folder: Path, number: int, gaussians: Gaussians, antialiased: bool) -> dict[str, Any]:
    """Write the levels of a leaf, coarser and coarser; returns its node of the tree."""
    reach = gaussians.scales.exp().amax(dim=1, keepdim=True)
    low, high = (gaussians.means - reach).amin(dim=0), (gaussians.means + reach).amax(dim=0)
    lods = {}
    for level in range(LEVELS):
        sog = packed("sog", Content(len(gaussians), gaussians.sh_degree, [gaussians], antialiased))
        zipfile.ZipFile(io.BytesIO(sog)).extractall(folder / f"{level}_{number}")
        lods[str(level)] = {"file": LEVELS * number + level, "offset": 0, "count": len(gaussians)}
        gaussians = merged_in_pairs(gaussians)
    return {"bound": {"min": low.tolist(), "max": high.tolist()}, "lods": lods}


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


def merged_in_pairs(gaussians: Gaussians) -> Gaussians:
    """A little more than half as many: pairs of neighbours are merged, first those that lose least."""
    if len(gaussians) < 2:
        return gaussians
    first, second = pairs(gaussians)
    alone = torch.ones(len(gaussians), dtype=torch.bool)
    alone[first], alone[second] = False, False
    return Gaussians.cat([gaussians[alone], merged(gaussians[first], gaussians[second])])


def pairs(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """Rows to merge, each row once: a pair is taken where neither has a better partner, until none is left.

    A pair loses what it does by Ward's method: the product of both weights over their sum, times the squared
    distance of the means, to which that of the colours is added over the area of both.
    """
    means, color = gaussians.means.double().numpy(), gaussians.features_dc.double().numpy()
    area, count = _area(gaussians.scales).numpy(), len(means)
    weight = area * gaussians.opacities[:, 0].double().sigmoid().numpy()
    near = cKDTree(means).query(means, k=min(NEIGHBOURS + 1, count))[1]
    first, second = np.repeat(np.arange(count), near.shape[1]), near.ravel()
    first, second = np.unique(np.sort([first, second], axis=0)[:, first != second], axis=1)
    squared = ((means[first] - means[second]) ** 2).sum(axis=1)
    squared += COLOR * (area[first] + area[second]) * ((color[first] - color[second]) ** 2).sum(axis=1)
    lost = squared * weight[first] * weight[second] / (weight[first] + weight[second])
    order = np.argsort(lost, kind="stable")
    first, second, chosen = first[order], second[order], []
    while len(first):
        best = np.full(count, len(first))
        for ends in (first, second):
            np.minimum.at(best, ends, np.arange(len(first)))
        mutual = np.unique(best[best < len(first)])
        mutual = mutual[(best[first[mutual]] == mutual) & (best[second[mutual]] == mutual)]
        chosen.append((first[mutual], second[mutual]))
        taken = np.zeros(count, dtype=bool)
        taken[first[mutual]], taken[second[mutual]] = True, True
        left = ~(taken[first] | taken[second])
        first, second = first[left], second[left]
    both = np.concatenate(chosen, axis=1)
    return torch.from_numpy(both[0]), torch.from_numpy(both[1])


def merged(first: Gaussians, second: Gaussians) -> Gaussians:
    """One Gaussian for each two, with the mean, covariance and colour of both. Each counts by its opacity
    times its area. Their sum stays, but what would be more than opaque becomes wider."""
    both = (first, second)
    weights = torch.stack([_area(each.scales) * each.opacities[:, 0].double().sigmoid() for each in both])
    share = (weights / weights.sum(dim=0))[..., None]
    means = torch.stack([each.means for each in both]).double()
    mean = (share * means).sum(dim=0)
    offset = (means - mean)[..., None]
    spread = torch.stack([_covariance(each) for each in both]) + offset * offset.transpose(2, 3)
    values, axes = torch.linalg.eigh((share[..., None] * spread).sum(dim=0))
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # no reflection
    scales = values.clamp_min(1e-30).log() / 2
    opacity = weights.sum(dim=0) / _area(scales)
    wider = (opacity / MOST_OPAQUE).clamp_min(1) ** WIDER
    mixed = replace(
        first,
        means=mean,
        scales=scales + wider.log()[:, None] / 2,
        quats=torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat()[:, [3, 0, 1, 2]]),
        features_dc=share[0] * first.features_dc + share[1] * second.features_dc,
        features_rest=share[0][..., None] * first.features_rest + share[1][..., None] * second.features_rest,
        opacities=torch.logit((opacity / wider).clamp_max(MOST_OPAQUE))[:, None],
    )
    return mixed.to(first.means)


def _area(scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """What a Gaussian fills from its broadest side, without a constant; float64."""
    return (scales.double().sum(dim=1) - scales.double().amin(dim=1)).exp().clamp_min(1e-100)


def _covariance(gaussians: Gaussians) -> Float[Tensor, "n 3 3"]:
    turned = Rotation.from_quat(gaussians.quats.double().numpy()[:, [1, 2, 3, 0]]).as_matrix()
    scaled = torch.from_numpy(turned) * gaussians.scales.double().exp()[:, None]
    return scaled @ scaled.transpose(1, 2)
