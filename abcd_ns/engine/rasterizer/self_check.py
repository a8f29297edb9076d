"""A backend proves itself on a tiny scene before it is trusted with hours of training."""

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.rasterizer.base import Raster, Rasterizer
from abcd_ns.engine.rasterizer.torch_backend import TorchRasterizer
from abcd_ns.engine.types import PARAM_NAMES, Gaussians, View

TOLERANCE = 2e-3
"""Largest difference allowed, relative to the largest value; float32 kernels with fast exponentials stay
well below, a wrong sign or a lost term is far above."""
WIDTH, HEIGHT, COUNT = 40, 24, 24


def check_scene(device: torch.device | str) -> tuple[Gaussians, View]:
    """24 Gaussians of degree 3, some overlapping, in front of a 40 x 24 camera; no random numbers."""
    i = torch.arange(COUNT, dtype=torch.float64)

    def wave(*frequencies: float) -> Float[Tensor, "n c"]:
        return torch.stack([torch.sin(f * (i + 1)) for f in frequencies], dim=-1)

    rest = wave(*(0.37 * (k + 1) for k in range(45))).view(COUNT, 15, 3)
    gaussians = Gaussians(
        means=wave(1.3, 2.1, 0.7) * torch.tensor([1.6, 1.0, 1.0], dtype=torch.float64)
        + torch.tensor([0.0, 0.0, 4.0]),
        scales=0.5 * wave(0.9, 1.7, 2.9) - 1.5,
        quats=wave(0.3, 1.1, 1.9, 2.3),
        features_dc=wave(0.6, 1.4, 2.2),
        features_rest=0.2 * rest,
        opacities=2 * wave(1.6) + 0.5,
    )
    K = torch.tensor([[32.0, 0.0, 19.5], [0.0, 30.0, 12.5], [0.0, 0.0, 1.0]])
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    return gaussians.to(device=device, dtype=torch.float32), View(viewmat, K, WIDTH, HEIGHT).to(device)


def _loss(raster: Raster) -> Float[Tensor, ""]:
    """Depends on every output of every pixel, differently."""
    planes = torch.cat((raster.color, raster.transmittance[..., None], 0.2 * raster.depth[..., None]), dim=-1)
    weights = torch.cos(torch.arange(planes.numel(), device=planes.device, dtype=planes.dtype)).view_as(
        planes
    )
    return (planes * weights).sum()


def _values_and_gradients(rasterizer: Rasterizer, device: torch.device | str) -> dict[str, Tensor]:
    gaussians, view = check_scene(device)
    leaves = {name: value.requires_grad_() for name, value in gaussians.items()}
    raster = rasterizer(Gaussians(**leaves), view, sh_degree=3)
    raster.info["means2d"].retain_grad()
    _loss(raster).backward()
    results = {"color": raster.color, "transmittance": raster.transmittance, "depth": raster.depth}
    results |= {f"gradient of {name}": leaves[name].grad for name in PARAM_NAMES}
    results["gradient of means2d"] = raster.info["means2d"].grad
    return {name: value.detach().cpu().double() for name, value in results.items()}


def self_check(rasterizer: Rasterizer, device: torch.device | str) -> float:
    """Compare a rasterizer with the torch backend, forward and gradient, on a tiny fixed scene.

    A backend whose picture is right and whose gradient is wrong trains to a much worse model without any
    error, as a port of gsplat to other hardware once did; hence this check at every start.

    Returns:
        The largest difference, relative to the largest value of its kind.

    Raises:
        RuntimeError: a value or gradient differs by more than rounding.
    """
    expected = _values_and_gradients(TorchRasterizer("never"), "cpu")
    found = _values_and_gradients(rasterizer, device)
    largest = 0.0
    for name, reference in expected.items():
        scale = reference.abs().max().clamp_min(1e-12)
        error = float((found[name] - reference).abs().max() / scale)
        if not error <= TOLERANCE:  # NaN fails too
            raise RuntimeError(
                f'The rasterizer "{rasterizer.name}" on {device} is off in {name} by {error:.2g} of the '
                f'largest value, so its kernels cannot be trusted there. Set the rasterizer to "torch".'
            )
        largest = max(largest, error)
    return largest
