"""The terrain of `abcd compare --tiles` as a COLMAP data set, for comparisons that hold views out.

python -m benchmarks.land land --tiles 32
abcd compare --data land --seconds 180 --blocks 1 8 32 --evals 4 --out blocks
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from PIL import Image

from abcd_ns.engine.types import View
from abcd_ns.errors import UserError
from abcd_ns.lab.synth.sparse_points import SparsePoints, write_model
from abcd_ns.lab.world.land import Land, color_of
from abcd_ns.lab.world.world import project


@dataclass
class Args:
    """What to draw."""

    out: Annotated[Path, tyro.conf.Positional]
    """A new folder, for images/ and sparse/0/."""
    tiles: int = 32
    """Of the land; a power of 2."""
    views: int = 4
    """Pictures of each tile."""
    points: int = 300
    """Sparse points on each tile."""
    width: int = 160
    """Of the pictures, in pixels."""
    height: int = 120
    """Of the pictures, in pixels."""


def points_on(land: Land, views: list[View], seed: int = 0) -> SparsePoints:
    """Points at random places of the land, in all views that hold them: nothing hides any."""
    rng, sides = np.random.default_rng(seed), [land.columns, land.tiles // land.columns]
    places = rng.uniform(size=(land.tiles * land.gaussians, 2)) * sides
    xyz = torch.from_numpy(np.concatenate([places, np.zeros((len(places), 1))], axis=1))
    colors = color_of(xyz[:, 0], xyz[:, 1])
    seen = []
    for view in views:
        xy, z = project(view, xyz.to(view.viewmat))
        within = (xy > 0) & (xy < torch.tensor([view.width, view.height]))
        inside = (z > view.near) & within.all(dim=1)
        which = torch.where(inside)[0]
        seen.append((which.numpy(), xy[which].numpy()))
    return SparsePoints(
        xyz.numpy(),
        (255 * colors).round().byte().numpy(),
        np.concatenate([which for which, _ in seen]),
        np.concatenate([np.full(len(which), c) for c, (which, _) in enumerate(seen)]),
        np.concatenate([xy for _, xy in seen]),
    )


def main(args: Args) -> None:
    """Draw and write it.

    Raises:
        UserError: the folder is there already.
    """
    if args.out.exists():
        raise UserError(f"{args.out} is there already; name another folder.")
    land = Land(args.tiles, args.points, args.views, args.width, args.height)
    views = land.cameras()
    names = [f"{number:05d}.png" for number in range(len(views))]
    (args.out / "images").mkdir(parents=True)
    for name, view in zip(names, views, strict=True):
        picture = land.crop(view, view.full)
        Image.fromarray((255 * picture).round().byte().numpy()).save(args.out / "images" / name)
    write_model(args.out / "sparse" / "0", dict(zip(names, views, strict=True)), points_on(land, views))
    print(f"{args.out}: {len(views)} pictures, {args.tiles * args.points} points")


if __name__ == "__main__":
    main(tyro.cli(Args))
