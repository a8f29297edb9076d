"""Rasterizers: one interface, a torch implementation for any device and gsplat's CUDA kernels."""

from typing import Literal

import torch

from abcd_ns.engine.render.base import CutShot as CutShot
from abcd_ns.engine.render.base import Raster as Raster
from abcd_ns.engine.render.base import Rasterizer as Rasterizer
from abcd_ns.engine.render.base import Shot as Shot
from abcd_ns.engine.render.cpu.backend import TorchRasterizer as TorchRasterizer
from abcd_ns.engine.render.projection import PrimitiveName as PrimitiveName
from abcd_ns.engine.render.self_check import self_check as self_check
from abcd_ns.engine.render.z_window import ZWindow as ZWindow
from abcd_ns.errors import UserError

WITHOUT_GSPLAT = ("cpu", "mps")
"""Types of devices."""


def make_rasterizer(
    name: Literal["auto", "torch", "gsplat"], device: torch.device | str, *, primitive: PrimitiveName = "3dgs"
) -> Rasterizer:
    """The rasterizer called `name`; "auto" takes gsplat where there may be kernels for it, else torch.

    gsplat's kernels are checked against the torch backend on a tiny scene first (see self_check).

    Raises:
        ValueError: gsplat was asked for on such a device.
        UserError: gsplat has no kernels.
        RuntimeError: gsplat's kernels do not agree with the torch backend.
    """
    device = torch.device(device)
    if name == "torch" or (name == "auto" and device.type in WITHOUT_GSPLAT):
        return TorchRasterizer(primitive=primitive)
    if device.type in WITHOUT_GSPLAT:
        raise ValueError(
            f'The gsplat rasterizer needs a CUDA device, not "{device}"; set the rasterizer to "torch".'
        )
    from abcd_ns.engine.render.cuda.backend import GsplatRasterizer  # imports gsplat

    rasterizer = GsplatRasterizer(primitive)
    try:
        self_check(rasterizer, device)
    except AttributeError as error:
        if "'NoneType'" not in str(error):  # its module of kernels
            raise
        raise UserError(
            "gsplat has no CUDA kernels and found no nvcc to compile them: put nvcc on the PATH "
            "(docs/troubleshooting.md), or train slowly with --pipeline.model.rasterizer torch."
        ) from error
    return rasterizer
