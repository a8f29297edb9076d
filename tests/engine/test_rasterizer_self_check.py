"""The self-check lets a sound backend pass and refuses one that is wrong in any way."""

import dataclasses

import pytest
import torch

from abcd_ns.engine.rasterizer import TorchRasterizer, self_check
from abcd_ns.engine.rasterizer.self_check import check_scene
from abcd_ns.engine.types import Gaussians


class Broken(TorchRasterizer):
    """A torch backend with a fault in one place."""

    name = "broken"

    def __init__(self, fault: str) -> None:
        super().__init__("never")
        self.fault = fault

    def __call__(self, gaussians, view, **options):
        if self.fault == "gradient of quats":  # right picture, gradient of the wrong sign
            wrong = 2 * gaussians.quats.detach() - gaussians.quats
            gaussians = Gaussians(**{**dict(gaussians.items()), "quats": wrong})
        if self.fault == "gradient of opacities":  # right picture, no gradient
            parts = {
                **dict(gaussians.items()),
                "opacities": gaussians.opacities.detach() + 0 * gaussians.opacities,
            }
            gaussians = Gaussians(**parts)
        raster = super().__call__(gaussians, view, **options)
        if self.fault in ("color", "depth"):
            return dataclasses.replace(raster, **{self.fault: 1.01 * getattr(raster, self.fault)})
        if self.fault == "transmittance":
            return dataclasses.replace(raster, transmittance=raster.transmittance * float("nan"))
        return raster


def test_a_sound_backend_passes():
    assert self_check(TorchRasterizer("never"), "cpu") == 0.0
    # Other tiles add up in another order: close, and not the very same computation.
    assert 0 < self_check(TorchRasterizer("never", tile_side=8, chunk=5), "cpu") < 1e-4


@pytest.mark.parametrize(
    "fault", ["color", "transmittance", "depth", "gradient of quats", "gradient of opacities"]
)
def test_a_fault_is_refused(fault):
    with pytest.raises(
        RuntimeError, match=rf'"broken" on cpu is off in {fault} by .* Set the rasterizer to "torch"'
    ):
        self_check(Broken(fault), "cpu")


def test_the_scene_would_show_faults():
    gaussians, view = check_scene("cpu")
    raster = TorchRasterizer("never")(gaussians, view, sh_degree=3)
    assert int((raster.info["radii"] > 0).sum()) > 20
    assert raster.transmittance.min() < 0.2
    assert raster.transmittance.max() > 0.9
    assert all(value.dtype == torch.float32 for _, value in gaussians.items())
