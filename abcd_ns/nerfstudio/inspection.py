"""What there is to train on, read and checked before a run begins."""

from dataclasses import dataclass
from pathlib import Path

from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig

from abcd_ns.data.dataset import PHOTOS, has_views, with_photos
from abcd_ns.data.input_errors import InputError
from abcd_ns.data.ply import count_gaussians
from abcd_ns.data.prepare import check_masks
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.datamanager import reading
from abcd_ns.nerfstudio.model import AbcdModelConfig


@dataclass(frozen=True)
class Inspected:
    """A capture, as far as memory hangs on it."""

    train: int
    """Views to train on."""
    held_out: int
    size: tuple[int, int]
    """Width and height of the largest photo as it is trained on, px."""
    points: int
    """0 where Gaussians begin at random."""
    factor: int
    """By which the photos' width and height are divided."""

    @property
    def pixels(self) -> int:
        """Of the largest photo as it is trained on."""
        return self.size[0] * self.size[1]

    def in_words(self) -> str:
        """One line for the terminal."""
        width, height = self.size
        reduced = f", divided by {self.factor}" if self.factor > 1 else ""
        views = f"{self.train:,} views to train on, {self.held_out:,} held out"
        return f"{views}; photos of up to {width} x {height} px{reduced}."


def inspect(config: DataParserConfig) -> Inspected:
    """Read the model, look at every photo and decode every mask.

    Raises:
        InputError: the data cannot be used.
    """
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
    points = len(parts[0].metadata.get("points3D_xyz", ()))
    return Inspected(train, held_out, largest, points, factor_of(parser))


def splats_to_begin_with(model: AbcdModelConfig, most: int | None) -> int:
    """Gaussians of the file that a run begins with; 0 without one.

    Args:
        most: that the scene may have; None for any number.

    Raises:
        UserError: the file cannot be read, or has more.
    """
    if (path := model.init_splats) is None:
        return 0
    if model.random_init:
        raise UserError("Give --pipeline.model.init-splats or --pipeline.model.random-init, not both.")
    count = count_gaussians(path)
    if most is not None and count > most:
        limit = f"--pipeline.training.density.max-gaussians is {most:,}"
        raise UserError(f"{path} has {count:,} Gaussians, but {limit}: raise it.")
    return count


def where_data_is(data: Path | None, config: Path) -> Path | None:
    """Where a run's data is: as its config.yml has it, seen from here or from a folder that the run lies in.

    Raises:
        UserError: nowhere.
    """
    places = [] if data is None else [base / data for base in (Path(), *config.absolute().parents)]
    for place in places:
        if place.exists():
            return place
    if places:
        raise UserError(
            f"{data}, on which this run was trained, does not exist: put it back, or a link to where it is "
            f"now (ln -s NEW_PLACE {data})."
        )
    return None


def factor_of(parser: DataParser) -> int:
    """By which the photos' width and height are divided, once the parser has read; 1 if it does not say."""
    given = (getattr(parser, name, None) for name in ("factor", "downscale_factor", "_downscale_factor"))
    return int(next((factor for factor in given if factor), 1))
