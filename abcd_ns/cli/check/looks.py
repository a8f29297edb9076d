"""Every photo, decoded once at reduced size: whether that works, how bright it is, what it is a copy of."""

import hashlib
import os
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from abcd_ns.data.photos import PhotoSource
from abcd_ns.data.picture_files import has_alpha, open_picture, orientation, undecodable
from abcd_ns.progress_bar import ProgressBar

REDUCED = (64, 64)
"""JPEG photos are decoded at an eighth of their size, or a larger one of at least this many pixels."""


@dataclass(frozen=True)
class Look:
    """What one photo showed."""

    brightness: float
    """Mean luma, 0 to 1; 0 where it could not be decoded."""
    orientation: int = 1
    """EXIF orientation, 1 to 8."""
    alpha: bool = False
    error: str | None = None
    """Why it cannot be decoded, in the words that training would end with."""


def look(source: PhotoSource) -> Look:
    """Decode one photo."""
    try:
        with open_picture(source.path) as picture:
            turned, alpha = orientation(picture), has_alpha(picture)
            picture.draft("L", REDUCED)
            histogram = np.array(picture.convert("L").histogram(), dtype=np.float64)
    except (OSError, SyntaxError, ValueError) as error:
        return Look(0.0, error=str(undecodable(source.path, error)))
    mean = histogram @ np.arange(256) / histogram.sum()
    return Look(float(mean / 255), turned, alpha)


def look_at_all(sources: Sequence[PhotoSource]) -> tuple[Look, ...]:
    """Decode all photos, several at a time, with a progress bar where that takes a while."""
    looks = []
    with ThreadPoolExecutor(os.cpu_count()) as pool, ProgressBar("Looking at photos", len(sources)) as bar:
        for found in pool.map(look, sources):
            looks.append(found)
            bar.advance()
    return tuple(looks)


def copies(sources: Sequence[PhotoSource]) -> list[list[int]]:
    """Groups of rows whose files are the same, byte for byte. Only files of equal length are read."""
    by_length: dict[int, list[int]] = defaultdict(list)
    for row, source in enumerate(sources):
        by_length[source.path.stat().st_size].append(row)
    groups: dict[tuple[int, bytes], list[int]] = defaultdict(list)
    for length, rows in by_length.items():
        for row in rows if len(rows) > 1 else ():
            groups[length, hashlib.blake2b(sources[row].path.read_bytes()).digest()].append(row)
    return [rows for rows in groups.values() if len(rows) > 1]
