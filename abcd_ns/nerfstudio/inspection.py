"""What there is to train on, read and checked before a run begins."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from scipy.spatial import cKDTree
from torch import Tensor

from abcd_ns.data.dataset import PHOTOS, has_views, with_photos
from abcd_ns.data.input_errors import InputError, say
from abcd_ns.data.ply import is_antialiased, some_means
from abcd_ns.data.prepare import check_masks
from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.datamanager import reading
from abcd_ns.nerfstudio.model import AbcdModelConfig
from abcd_ns.nerfstudio.views import views_of
from abcd_ns.run.store import MadeFor

SOME_MEANS = 1000  # of a file's Gaussians that are looked for among the points


@dataclass(frozen=True)
class Inspected:
    """What a run's memory and start depend on."""

    train: int  # views to train on
    held_out: int
    size: tuple[int, int]  # width and height of the largest photo as it is trained on, px
    points: int
    factor: int  # by which the photos' width and height are divided
    cloud: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)), compare=False)
    """The points, in the run's frame, [n, 3]."""
    to_run: Similarity | None = field(default=None, compare=False)  # from the frame of the photos' poses
    capture: DataparserOutputs | None = field(default=None, compare=False)
    """The photos to train on and their cameras."""

    @property
    def pixels(self) -> int:
        """Of the largest photo."""
        return self.size[0] * self.size[1]

    def made_for(self, training: TrainingConfig) -> MadeFor:
        """What a run on this, with such options, is made for."""
        return MadeFor.of(self.capture.image_filenames, views_of(self.capture.cameras), training)

    def check_seen(self) -> None:
        """Refuse points of which no view to train on shows one."""
        points, views = torch.from_numpy(self.cloud), views_of(self.capture.cameras)
        if len(points) and not any(bool(view.depths_of(points)[1].any()) for view in views):
            fix = "take both from one model (ply_file_path must be in the coordinates of the frames)"
            raise InputError(f"None of the {len(points):,} points lies in a photo to train on; {fix}.")

    def in_words(self) -> str:
        """One line for the terminal."""
        width, height = self.size
        reduced = f", divided by {self.factor}" if self.factor > 1 else ""
        views = f"{self.train:,} views to train on, {self.held_out:,} held out"
        return f"{views}; photos of up to {width} x {height} px{reduced}."


def inspect(config: DataParserConfig) -> Inspected:
    """Read the model, look at every photo and decode every mask; an InputError lists what cannot be used."""
    parser = config.setup()
    with reading(config):
        read = [parser.get_dataparser_outputs(split=split) for split in ("train", "val")]
    parts = [with_photos(outputs) for outputs in read if has_views(outputs)]
    if not has_views(read[0]):
        raise InputError(f"{config.data} has no photos to train on.")
    sources = list(dict.fromkeys(source for part in parts for source in part.metadata[PHOTOS]))
    check_masks(sources)
    largest = max((source.size for source in sources), key=lambda size: size[0] * size[1])
    train, held_out = (len(outputs.image_filenames) if has_views(outputs) else 0 for outputs in read)
    cloud = np.asarray(parts[0].metadata.get("points3D_xyz", np.zeros((0, 3))))
    to_run = Similarity.of(parts[0].dataparser_transform, parts[0].dataparser_scale)
    return Inspected(train, held_out, largest, len(cloud), factor_of(parser), cloud, to_run, parts[0])


def splats_to_begin_with(model: AbcdModelConfig, training: TrainingConfig, found: Inspected) -> int:
    """Number of Gaussians in the file that a run begins with; 0 without one. A UserError if it cannot be
    read, has too many of them, or lies elsewhere than the points."""
    if (path := model.init_splats) is None:
        return 0
    if model.random_init:
        raise UserError("Give --pipeline.model.init-splats or --pipeline.model.random-init, not both.")
    (count, means), most = some_means(path, SOME_MEANS), training.density.limit
    if most is not None and count > most:
        limit = f"--pipeline.training.density.max-gaussians is {most:,}"
        raise UserError(f"{path} has {count:,} Gaussians, but {limit}: raise it.")
    if is_antialiased(path) and not training.antialiased:
        say(f"{path} was trained with --pipeline.training.antialiased True: add that.")
    _check_place(path, means, found)
    return count


def _check_place(path: Path, means: Float64[Tensor, "n 3"], found: Inspected) -> None:
    """Check that most of these are as near to the points as Gaussians trained from them would be."""
    cloud = found.cloud[np.isfinite(found.cloud).all(axis=1)]
    if not len(cloud) or not len(means):
        return
    tree, middle = cKDTree(cloud), np.median(cloud, axis=0)
    as_it_is, moved = (np.median(tree.query(places)[0]) for places in (means, found.to_run.points(means)))
    if as_it_is < moved / 4:
        raise UserError(f"{path} is in nerfstudio's frame: write it by `abcd export`, without --frame.")
    if moved > np.median(np.linalg.norm(cloud - middle, axis=1)):
        raise UserError(f"{path} lies elsewhere than the points: it is of another scene, or frame.")


def where_data_is(data: Path | None, config: Path) -> Path | None:
    """Where a run's data is: the path in its config.yml, from here or from a folder that the run lies in."""
    if data is None:
        return None
    for base in (Path(), *config.absolute().parents):
        if (base / data).exists():
            return base / data
    raise UserError(
        f"{data}, on which this run was trained, does not exist: put it back, or a link to where it is now "
        f"(ln -s NEW_PLACE {data})."
    )


def factor_of(parser: DataParser) -> int:
    """By which a parser that has read divides the photos' width and height; 1 if it does not say."""
    given = (getattr(parser, name, None) for name in ("factor", "downscale_factor", "_downscale_factor"))
    return int(next((factor for factor in given if factor), 1))
