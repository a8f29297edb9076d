"""Rasterizers: one interface, a torch implementation for any device and gsplat's CUDA kernels."""

from abcd_ns.engine.rasterizer.base import Raster, Rasterizer, ZWindow

__all__ = ["Raster", "Rasterizer", "ZWindow"]
