"""A backend proves itself on a tiny scene before it is trusted with hours of training."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.base import Raster, Rasterizer, Shot
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.render.z_window import ZWindow
from abcd_ns.engine.types import PARAM_NAMES, Crop, Gaussians, View

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
    return gaussians.to(device=device, dtype=torch.float32), View(viewmat, K, WIDTH, HEIGHT)


@dataclass(frozen=True)
class Case:
    """Something that training asks of a rasterizer."""

    name: str
    crop: Crop | None = None
    frozen: int = 0
    """So many of the Gaussians are frozen."""
    sizes: tuple[float, ...] = (1.0,)
    """Views are drawn together, each with an image so many times as large as the scene's."""
    antialiased: bool = False
    windowed: bool = False
    """Each tile has a z window, some of them empty."""
    wants_weights: bool = False
    """The Gaussians' weights are asked for, in place of depths."""
    sh_degree: int = 3

    def shots(self, rasterizer: Rasterizer, frozen: Gaussians, view: View) -> list[Shot]:
        """What is to be drawn."""
        views = [view.resized(k, round(k * view.width), round(k * view.height)) for k in self.sizes]
        options = {"sh_degree": self.sh_degree, "antialiased": self.antialiased}
        seen = [rasterizer.project(frozen, each, **options) if self.frozen else None for each in views]
        crops = [self.crop or each.full for each in views]
        windows = [_window(rasterizer, crop, frozen.device) if self.windowed else None for crop in crops]
        return [Shot(*shot) for shot in zip(views, crops, seen, windows, strict=True)]


CASES = (
    Case("a whole view"),
    Case("an antialiased view", antialiased=True),
    Case("a crop", crop=Crop(9, 5, 23, 13), sh_degree=1),
    Case("a view with frozen splats", frozen=9),
    Case("weights beside frozen splats", frozen=9, wants_weights=True),
    Case("a crop with frozen splats", crop=Crop(18, 3, 17, 20), frozen=9, antialiased=True),
    Case("two views of different sizes", sizes=(1.0, 1.4), sh_degree=2),
    Case("a z window", windowed=True),
    Case("a crop with frozen splats in a z window", crop=Crop(18, 3, 17, 20), frozen=9, windowed=True),
)


def _window(rasterizer: Rasterizer, crop: Crop, device: torch.device) -> ZWindow:
    """Windows that differ from tile to tile."""
    grid = rasterizer.window_grid(crop)
    tile = torch.arange(grid.tiles, device=device, dtype=torch.float32)
    near = 3.6 + torch.sin(2.3 * tile)
    return ZWindow(grid, near, near + 1.1 + torch.sin(1.7 * tile + 1))


def _loss(raster: Raster) -> Float[Tensor, ""]:
    """Depends on every output of every pixel, differently."""
    planes = torch.cat((raster.color, raster.transmittance[..., None], 0.2 * raster.depth[..., None]), dim=-1)
    weights = torch.arange(planes.numel()).to(planes).cos().view_as(planes)
    return (planes * weights).sum()


def _residual(raster: Raster) -> Float[Tensor, "h w 4"]:
    """Something that differs from pixel to pixel."""
    height, width = raster.depth.shape
    return torch.arange(4 * height * width).to(raster.depth).sin().view(height, width, 4)


@torch.enable_grad()  # evaluation and rendering ask for the first picture without
def _values_and_gradients(
    rasterizer: Rasterizer, device: torch.device | str, case: Case
) -> dict[str, Tensor]:
    """All that a rasterizer finds in a case, by name; float64 on the CPU."""
    gaussians, view = check_scene(device)
    own, frozen = gaussians[: COUNT - case.frozen], gaussians[COUNT - case.frozen :]
    leaves = {name: value.clone().requires_grad_() for name, value in own.items()}
    shots = case.shots(rasterizer, frozen, view)
    options = {"antialiased": case.antialiased, "blend_weights": case.wants_weights, "residual_sums": True}
    rasters = rasterizer.draw(Gaussians(**leaves), shots, sh_degree=case.sh_degree, **options)
    infos = list({id(raster.info): raster.info for raster in rasters}.values())
    for info in infos:
        info["means2d"].retain_grad()
        info["sums"].ask([_residual(raster) for raster in rasters if raster.info is info])
    sum(map(_loss, rasters)).backward()
    planes = ("color", "transmittance", "depth")
    results = {name: [getattr(raster, name).flatten() for raster in rasters] for name in planes}
    results |= {f"gradient of {name}": [leaves[name].grad] for name in PARAM_NAMES}
    results["gradient of means2d"] = [info["means2d"].grad for info in infos]
    results["sums of residuals"] = [info["sums"].values for info in infos]
    results |= {"weights": [info["weights"].grad for info in infos]} if case.wants_weights else {}
    return {name: torch.cat(value).detach().cpu().double() for name, value in results.items()}


def self_check(rasterizer: Rasterizer, device: torch.device | str) -> float:
    """Compare a rasterizer with the torch backend, forward and gradient, on a tiny fixed scene, in all CASES.

    A backend whose picture is right and whose gradient is wrong trains to a much worse model without any
    error, as a port of gsplat to other hardware once did; hence this check at every start.

    Returns:
        The largest difference, relative to the largest value of its kind.

    Raises:
        RuntimeError: a value or gradient differs by more than rounding.
    """
    options = {"tile_side": rasterizer.tile_side, "primitive": rasterizer.primitive.name}
    largest, reference = 0.0, TorchRasterizer(use_native=False, **options)
    for case in CASES:
        expected = _values_and_gradients(reference, "cpu", case)
        found = _values_and_gradients(rasterizer, device, case)
        for name, value in expected.items():
            error = float((found[name] - value).abs().max() / value.abs().max().clamp_min(1e-12))
            if not error <= TOLERANCE:  # NaN fails too
                raise RuntimeError(
                    f'The rasterizer "{rasterizer.name}" on {device} is off in {name} of {case.name} by '
                    f"{error:.2g} of the largest value, so its kernels cannot be trusted there. Set the "
                    'rasterizer to "torch".'
                )
            largest = max(largest, error)
    return largest
