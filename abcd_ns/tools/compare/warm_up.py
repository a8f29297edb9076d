"""Compiles the torch rasterizer's kernels before a clock runs, so that what is timed is training."""

import torch

from abcd_ns.engine.rasterizer import Rasterizer, TorchRasterizer, ZWindow
from abcd_ns.engine.rasterizer.chunk_kernels import has_cpp_compiler
from abcd_ns.engine.rasterizer.self_check import check_scene


def warm_up(rasterizer: Rasterizer, device: torch.device, *, absgrad: bool, windows: bool) -> None:
    """Draw and differentiate a tiny scene in every way that training will.

    From then on the kernels are compiled, from the first call to the last: by default they would be compiled
    in the middle of a run, at a moment that depends on the machine's load. Does nothing where there is
    nothing to compile: on another device, without a C++ compiler, and with kernels that came compiled.

    Args:
        absgrad: whether densification asks for absolute gradients.
        windows: whether frozen Gaussians will be sorted in, and layers drawn, within windows of depth.
    """
    if not isinstance(rasterizer, TorchRasterizer) or device.type != "cpu" or not has_cpp_compiler():
        return
    rasterizer.kernels.policy = "always"
    gaussians, view = check_scene(device)
    everywhere = torch.full((view.height, view.width), float("inf"))
    window = ZWindow(-everywhere, everywhere)
    for around in [{}, {"frozen": gaussians, "z_window": window}][: 1 + windows]:
        gaussians.features_dc.requires_grad_().grad = None
        raster = rasterizer(gaussians, view, sh_degree=0, absgrad=absgrad, **around)
        raster.color.sum().backward()
