"""A layer cache on disk whose files are to be damaged, and a look at what it still believes."""

import os
from pathlib import Path

import torch

from abcd_ns.engine.storage import LayerCache, LayerKey, through_codec
from abcd_ns.engine.types import Crop, Layer

ENTRIES = 40
SIZE = 40
MIB = 1 << 20


def key(index: int) -> LayerKey:
    """Of the entry with this number."""
    settings = {"sh_degree": 0, "raster_mode": "classic", "rasterizer": "torch-1", "bits": 16}
    return LayerKey(scene="s", view=str(index), crop=Crop(0, 0, SIZE, SIZE), content=((0, 1),), **settings)


def layer(index: int) -> Layer:
    """What was put there."""
    generator = torch.Generator().manual_seed(index)
    return Layer(torch.rand(SIZE, SIZE, 3, generator=generator), torch.rand(SIZE, SIZE, generator=generator))


def fill_cache(folder: Path) -> None:
    """Make the cache, and close it."""
    with LayerCache(folder, MIB) as cache:
        cache.put_many((key(index), layer(index)) for index in range(ENTRIES))


def look_at_cache(folder: Path) -> None:
    """End this process with 0 if every entry is right or missing, and the cache takes new ones; or with 1."""
    torch.set_num_threads(1)
    with LayerCache(folder, MIB) as cache:
        believed = all(_is_right(cache.get(key(index)), index) for index in range(ENTRIES))
        cache.put(key(0), layer(0))
        goes_on = cache.get(key(0)) is not None
    os._exit(0 if believed and goes_on else 1)


def _is_right(found: Layer | None, index: int) -> bool:
    if found is None:
        return True
    expected = through_codec(layer(index), 16)
    return torch.equal(found.color, expected.color) and torch.equal(
        found.transmittance, expected.transmittance
    )
