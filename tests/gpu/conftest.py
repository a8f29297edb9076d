"""Where the tests of this folder run, and what draws there.

With ABCD_TEST_DEVICE=cpu they run without CUDA, against the torch rasterizer with gsplat's tiles: that tries
the tests, not the kernels.
"""

import os

import pytest
import torch

from abcd_ns.engine.render import Rasterizer, TorchRasterizer, make_rasterizer
from abcd_ns.engine.render.projection import PRIMITIVES
from tests.engine.conftest import make, photos, start

__all__ = ["device", "make", "photos", "rasterizer", "rasterizers", "start"]


@pytest.fixture(scope="session")
def device() -> torch.device:
    """The CUDA device, or what ABCD_TEST_DEVICE names."""
    found = torch.device(os.environ.get("ABCD_TEST_DEVICE", "cuda"))
    if found.type == "cuda" and not torch.cuda.is_available():
        pytest.skip("there is no CUDA device")
    return found


@pytest.fixture(scope="session")
def rasterizers(device) -> dict[str, Rasterizer]:
    """Those under test, by primitive; gsplat's are checked against the torch backend as they are made."""
    if device.type == "cuda":
        return {name: make_rasterizer("gsplat", device, primitive=name) for name in PRIMITIVES}
    return {name: TorchRasterizer(use_native=False, tile_side=16, primitive=name) for name in PRIMITIVES}


@pytest.fixture(scope="session")
def rasterizer(rasterizers) -> Rasterizer:
    """That of 3DGS."""
    return rasterizers["3dgs"]
