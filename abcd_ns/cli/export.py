"""`abcd export`: a trained scene as a file that viewers read, whole, by block, or within a box."""

import json
import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.cli.paths import check_file, find_run
from abcd_ns.engine.gaussians.block_state import DRAWN, IS_DEFERRED, Packed
from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore, StoreError
from abcd_ns.engine.store.atomic import replacing
from abcd_ns.engine.store.special_blocks import PENDING, BlockName
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.glb import Z_TO_Y
from abcd_ns.formats.packed import BYTES_AT_ONCE, MOST_SOG, WIDEST_SPZ
from abcd_ns.formats.ply import Content
from abcd_ns.formats.scene_file import PACKED, rounding, shows, suffix_of, write_scene
from abcd_ns.formats.streamed import write_streamed
from abcd_ns.machine import threads_wanted
from abcd_ns.progress_bar import tracked
from abcd_ns.run import STATE, STORE
from abcd_ns.run.store import MADE_FOR
from abcd_ns.terminal import many
from abcd_ns.units import bytes_in_words

TRANSFORMS = "dataparser_transforms.json"
"""nerfstudio's file with the transform from the data's frame to the run's."""
LOST_DIGITS = 1e-4  # rounding errors above this share of the scene's size are printed
Box = tuple[float, float, float, float, float, float]  # x, y and z of its lower and then of its upper corner


def export(
    run: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")],
    by_block: bool = False,
    lod: bool = False,
    box: Annotated[Box | None, tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="")] = None,
    frame: Literal["data", "nerfstudio"] = "data",
) -> int:
    """Write a trained scene for viewers of 3D Gaussian Splatting: .ply, .spz, .sog, .glb.

    abcd export outputs/garden/abcd/TIME --out garden.ply

    abcd export outputs/garden/abcd/TIME --out parts --by-block

    abcd export outputs/garden/abcd/TIME --out streamed --lod

    The suffix of --out sets the format. .ply is read everywhere and loses nothing. .spz, .sog and
    .compressed.ply are for the web, 4 to 15 times smaller. .glb is glTF with KHR_gaussian_splatting.

    Works on runs that were stopped or killed, too. .ply and .glb are written block by block, so that no scene
    is too large. Gaussians too transparent for any rasterizer are left out.

    Args:
        run: Folder of the run, outputs/SCENE/METHOD/TIME, or its config.yml.
        out: A new file that ends in .ply, .compressed.ply, .spz, .sog or .glb.
            With --by-block a new folder, whose files are .ply, or end as its own name does.
            With --lod a new folder.
        by_block: Write one file for each block.
        lod: Write streamed SOG, of which viewers load what they show, as coarse as its distance allows.
        box: Export only Gaussians whose means lie in this box, in the coordinates of `frame`.
        frame: "data" has the coordinates and scale of the photos' poses, as in COLMAP or transforms.json.
            Where transforms.json holds an `applied_transform`, those before it.
            "nerfstudio" has those of the run, its viewer and `ns-export`.
    """
    check_request(out, box)
    if by_block and lod:
        raise UserError("--lod cuts the scene into files by itself; leave out --by-block.")
    run = find_run(run, STORE)
    suffix = suffix_of(Path(".sog") if lod else out, ".ply" if by_block else None)
    to = to_data(run) if frame == "data" else None
    with stored(run) as store:
        scene = Shown(store, to, box)
        counts = {block: n for block in tracked(scene.blocks, "counting") if (n := scene.count(block))}
        if not counts:
            raise UserError("There is no Gaussian to export" + (" in this box." if box else "."))
        if suffix in PACKED and not lod:
            most = (max if by_block else sum)(counts.values())
            if suffix == ".sog" and most > MOST_SOG and scene.sh_degree:
                why = f"A .sog of {most:,} Gaussians with harmonics takes too long; {MOST_SOG:,} are quick"
                raise UserError(f"{why}. To pack more, use --lod, or .compressed.ply.")
            ram = bytes_in_words(most * BYTES_AT_ONCE)
            print(f"{suffix} is packed at once, in about {ram} of RAM; .ply and .glb are not.")
        if by_block or lod:
            written = _write_folder(scene, counts, out, suffix, lod)
        else:
            written = _write(scene, counts, out, suffix)
    _report(written, counts, scene, suffix)
    return 0


def check_request(out: Path, box: Box | None) -> None:
    """Raises UserError where `out` cannot be made, or `box` holds nothing."""
    if out.exists():
        raise UserError(f"--out {out} exists already; choose another name.")
    check_file("--out", out)
    if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise UserError("--box needs X0 < X1, Y0 < Y1 and Z0 < Z1.")


def to_data(run: Path) -> Similarity:
    """From the run's frame back to that of the data; UserError where the file is missing or damaged."""
    path = run / TRANSFORMS
    try:
        found = json.loads(path.read_text())
        matrix = torch.tensor(found["transform"], dtype=torch.float64).reshape(3, 4)
        return Similarity.of(matrix, found["scale"]).inverse
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        raise UserError(f"{path} cannot be read ({error}); use --frame nerfstudio.") from None


@contextmanager
def stored(run: Path) -> Iterator[ParameterStore]:
    """The blocks of a run; UserError where they cannot be read, or none can be shown yet."""
    try:
        with ParameterStore.open(run / STATE / STORE, read_only=True) as store:
            state = RunState.from_json(store.state) if store.state else None
            if state is None or (state.active is not None and state.active.is_whole):
                raise UserError(
                    f"{store.folder}: no block has been trained yet. Wait until the warm-up is over, or use "
                    "`ns-export gaussian-splat` on a checkpoint."
                )
            yield store
    except StoreError as error:
        raise UserError(f"{error} If the run is training, wait until it has ended.") from None


def inside(box: Box, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Which points lie in the box."""
    low, high = points.new_tensor(box[:3]), points.new_tensor(box[3:])
    return ((points >= low) & (points < high)).all(dim=1)


@dataclass
class Shown:
    """The Gaussians of a store that are to be written: those in `box`, if there is one, in the frame `to`, or
    in their own without any."""

    store: ParameterStore
    to: Similarity | None
    box: Box | None

    def __post_init__(self) -> None:
        self._tree = BlockTree.from_json(self.store.header["tree"])
        self.blocks = range(self._tree.num_blocks)
        self.antialiased: bool = self.store.header.get(MADE_FOR, {}).get("antialiased", False)
        self._corners = torch.zeros(0, 3, dtype=torch.float64)  # the lowest and highest coordinates so far
        self.widest = 0.0  # the largest standard deviation so far, in the units of the file
        self.faint = 0  # of those that were counted, how many no rasterizer draws

    @cached_property
    def sh_degree(self) -> int:
        """Of all its Gaussians."""
        return Gaussians(**self._load(0, PARAM_NAMES)).sh_degree

    @property
    def largest(self) -> float:
        """Of all coordinates that were given so far, without their signs."""
        return float(self._corners.abs().max())

    @property
    def size(self) -> float:
        """The longest side of their box."""
        return float((self._corners[1] - self._corners[0]).max())

    def count(self, block: int) -> int:
        """How many of the block's Gaussians are to be written."""
        found = self._load(block, ("means", "opacities"))
        here, drawn = self._here(self._placed(found["means"])), shows(found["opacities"])
        self.faint += int((here & ~drawn).sum())
        return int((here & drawn).sum())

    def gaussians(self, block: int) -> Gaussians:
        found = Gaussians(**self._load(block, PARAM_NAMES))
        found = found[self._here(self._placed(found.means)) & shows(found.opacities)]
        if not len(found):
            return found
        exact = torch.cat((self._corners, self._placed(found.means)))
        self._corners = torch.stack((exact.amin(0), exact.amax(0)))
        found = found if self.to is None else self.to.gaussians(found)
        self.widest = max(self.widest, math.exp(found.scales.max()))
        return found

    def _load(self, block: int, names: tuple[str, ...]) -> dict[str, Tensor]:
        """These parameters, the means among them, of the block's active Gaussians and of pending migrants."""
        found = self._columns(block, names)
        seen = ~found.pop(IS_DEFERRED)
        found = {name: value[seen] for name, value in found.items()}
        if PENDING not in self.store.blocks:
            return found
        pending = self._columns(PENDING, names)
        here = self._tree.assign(pending["means"]) == block
        return {name: torch.cat([value, pending[name][here]]) for name, value in found.items()}

    def _columns(self, name: BlockName, names: tuple[str, ...]) -> dict[str, Tensor]:
        if "features_rest" not in names:
            return self.store.load(name, (*names, IS_DEFERRED))[0]
        packed = Packed(*self.store.load(name, DRAWN))
        return {**dict(packed.gaussians().items()), IS_DEFERRED: packed.tensors[IS_DEFERRED]}

    def _placed(self, means: Tensor) -> Tensor:
        return means.double() if self.to is None else self.to.points(means)

    def _here(self, means: Tensor) -> Bool[Tensor, "n"]:
        return torch.ones(len(means), dtype=torch.bool) if self.box is None else inside(self.box, means)


def _write(scene: Shown, counts: dict[int, int], out: Path, suffix: str) -> list[Path]:
    # Turned so that y is up; in the run's own frame z is.
    up = Z_TO_Y if scene.to is None else Z_TO_Y @ scene.to.rotation.T
    parts = (scene.gaussians(block) for block in tracked(counts, "writing"))
    with replacing(out) as partial:
        content = Content(sum(counts.values()), scene.sh_degree, parts, scene.antialiased)
        write_scene(partial, suffix, up, content)
        rounding(suffix, scene.largest)
    return [out]


def _write_folder(scene: Shown, counts: dict[int, int], out: Path, suffix: str, lod: bool) -> list[Path]:
    """Levels of detail, or a file for each block."""
    out.mkdir()
    try:
        if lod:
            parts = (scene.gaussians(block) for block in tracked(counts, "writing"))
            processes = threads_wanted() if sum(counts.values()) > MOST_SOG else 1
            return write_streamed(out, parts, scene.antialiased, processes)
        for block in tracked(counts, "writing"):
            _write(scene, {block: counts[block]}, out / f"block-{block + 1:04d}{suffix}", suffix)
        return list(out.iterdir())
    except BaseException:  # a full disk, or Ctrl-C: a part of the scene is of no use
        shutil.rmtree(out)
        raise


def _report(written: Sequence[Path], counts: dict[int, int], scene: Shown, suffix: str) -> None:
    size, count = sum(path.stat().st_size for path in written), sum(counts.values())
    where = written[0] if len(written) == 1 else f"{written[0].parent} ({len(written)} files)"
    print(f"{where}: {count:,} Gaussians, {bytes_in_words(size)}, {size / count:.0f} bytes each")
    if scene.faint:
        print(f"{many(scene.faint, 'Gaussian', 'Gaussians')} too transparent to be drawn left out.")
    tell_rounding(suffix, scene.largest, scene.size)
    if suffix == ".spz" and scene.widest > WIDEST_SPZ:
        lost = f"Of Gaussians, up to {scene.widest:,.0f} units wide, .spz holds {WIDEST_SPZ:.0f} at most"
        print(f"{lost}: wider ones shrink. .sog and .ply keep them.")
    if scene.antialiased:
        print("Trained antialiased: enable antialiasing in the viewer, or thin things look too thick.")


def tell_rounding(suffix: str, largest: float, size: float) -> None:
    """Print by how much positions are off, where that is more than LOST_DIGITS of the scene's `size`.
    `largest` is that of all coordinates."""
    off = rounding(suffix, largest)
    if size > 0 and off > LOST_DIGITS * size:
        far = ": the data's origin is far away. --frame nerfstudio keeps all digits."
        remedy = "; .sog and .ply are finer." if suffix == ".spz" else far
        print(f"{suffix} rounds positions to {off:.1g}, {off / size:.1g} of the scene's size{remedy}")
