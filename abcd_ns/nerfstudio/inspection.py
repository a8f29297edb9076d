"""What there is to train on, read and checked before a run begins."""

from dataclasses import dataclass

from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig

from abcd_ns.data.dataset import PHOTOS, has_views, with_photos
from abcd_ns.data.input_errors import InputError
from abcd_ns.data.prepare import check_masks
from abcd_ns.nerfstudio.datamanager import reading


@dataclass(frozen=True)
class Inspected:
    """A capture, as far as memory hangs on it."""

    pixels: int
    """Of the largest photo as it is trained on."""
    points: int
    """0 where Gaussians begin at random."""
    factor: int
    """By which the photos' width and height are divided."""


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
    largest = max(width * height for width, height in (source.size for source in sources))
    return Inspected(largest, len(parts[0].metadata.get("points3D_xyz", ())), factor_of(parser))


def factor_of(parser: DataParser) -> int:
    """By which the photos' width and height are divided, once the parser has read; 1 if it does not say."""
    given = (getattr(parser, name, None) for name in ("factor", "downscale_factor", "_downscale_factor"))
    return int(next((factor for factor in given if factor), 1))
