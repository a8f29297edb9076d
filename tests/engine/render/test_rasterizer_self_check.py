"""The self-check lets a sound backend pass and refuses one that is wrong in any way."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.kernels.native import library
from abcd_ns.engine.render import TorchRasterizer, self_check
from abcd_ns.engine.render.self_check import TOLERANCE


class Broken(TorchRasterizer):
    def __init__(self, fault: str) -> None:
        super().__init__(use_native=False)
        self.name, self.fault = "broken", fault

    def project(self, gaussians, view, **options):
        splats = super().project(gaussians, view, **options)
        return splats[torch.arange(len(splats) - 1)] if self.fault == "a frozen splat missing" else splats

    def draw(self, gaussians, shots, **options):
        quats, opacities = gaussians.quats, gaussians.opacities
        if self.fault == "wrong sign":  # and the picture is right, as without gradient
            gaussians = replace(gaussians, quats=2 * quats.detach() - quats)
        if self.fault == "no gradient":
            gaussians = replace(gaussians, opacities=opacities.detach() + 0 * opacities)
        if self.fault == "antialiasing lost":
            options["antialiased"] = False
        if self.fault == "degree of harmonics lost":
            options["sh_degree"] = max(options["sh_degree"], 3)
        rasters = super().draw(gaussians, [self._shot(shot, shots[0]) for shot in shots], **options)
        return tuple(self._raster(raster) for raster in rasters)

    def _shot(self, shot, first):
        if self.fault == "crop shifted" and shot.crop.x:
            return replace(shot, crop=shot.crop._replace(x=shot.crop.x - 1))
        if self.fault == "frozen ignored":
            return replace(shot, frozen=None)
        if self.fault == "window ignored" or (self.fault == "window of own" and shot.frozen is not None):
            return replace(shot, z_window=None)
        if self.fault == "camera of the first":
            return replace(shot, view=replace(shot.view, K=first.view.K))
        return shot

    def _raster(self, raster):
        if self.fault == "sums of nothing":
            sums = raster.info["sums"]
            sums.ask = lambda residuals: setattr(sums, "values", 0 * sums._find(residuals) + 1)
        if self.fault in ("color", "depth"):
            return replace(raster, **{self.fault: 1.01 * getattr(raster, self.fault)})
        if self.fault == "transmittance":
            return replace(raster, transmittance=raster.transmittance * float("nan"))
        return raster


def test_a_sound_backend_passes():
    with torch.no_grad():  # as evaluation asks for it
        assert self_check(TorchRasterizer(use_native=False), "cpu") == 0.0
    if library() is not None:  # close, and not the very same
        assert 0 < self_check(TorchRasterizer(), "cpu") < 1e-4
        assert 0 < self_check(TorchRasterizer(primitive="2dgs"), "cpu") < 5e-4


@pytest.mark.parametrize(
    ("fault", "what", "case"),
    [
        ("color", "color", "a whole view"),
        ("transmittance", "transmittance", "a whole view"),
        ("depth", "depth", "a whole view"),
        ("wrong sign", "gradient of quats", "a whole view"),
        ("no gradient", "gradient of opacities", "a whole view"),
        ("sums of nothing", "sums of residuals", "a whole view"),
        ("antialiasing lost", "color", "an antialiased view"),
        ("crop shifted", "color", "a crop"),
        ("degree of harmonics lost", "color", "a crop"),
        ("frozen ignored", "color", "a view with frozen splats"),
        ("a frozen splat missing", "color", "a view with frozen splats"),
        ("camera of the first", "color", "two views of different sizes"),
        ("window ignored", "color", "a z window"),
        ("window of own", "color", "a crop with frozen splats in a z window"),
    ],
)
def test_a_fault_is_refused(fault, what, case):
    said = rf'"broken" on cpu is off in {what} of {case} by .* Set the rasterizer to "torch"'
    with pytest.raises(RuntimeError, match=said):
        self_check(Broken(fault), "cpu")


@pytest.mark.parametrize("shift", [-3e-5, 3e-5])
def test_no_case_hangs_on_rounding(shift):
    """No fragment is so near to a threshold of drawing that other kernels' rounding would change sides."""

    class Rounding(TorchRasterizer):
        def draw(self, gaussians, shots, **options):
            logits = gaussians.opacities + shift
            return super().draw(replace(gaussians, opacities=logits), shots, **options)

    assert 0 < self_check(Rounding(use_native=False, tile_side=16), "cpu") < TOLERANCE / 4
