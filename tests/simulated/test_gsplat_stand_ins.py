"""gsplat is chosen where there is an accelerator, agrees with torch there, and is missed in one line."""

import pytest

from abcd_ns.engine import render
from abcd_ns.engine.render import TorchRasterizer, make_rasterizer
from abcd_ns.errors import UserError
from tests.reference.simulated_device import DEVICE


@pytest.mark.usefixtures("simulated_gsplat")
@pytest.mark.parametrize(("primitive", "name"), [("3dgs", "gsplat"), ("2dgs", "surfel-gsplat")])
def test_auto_is_gsplat_on_the_simulated_device_and_agrees_with_torch(primitive, name):
    assert make_rasterizer("auto", DEVICE, primitive=primitive).name.startswith(name)  # which is checked
    assert make_rasterizer("torch", DEVICE).name.startswith("torch")


def test_where_gsplat_has_no_kernels_one_line_says_so(monkeypatch):
    monkeypatch.setattr(render, "self_check", lambda *_: None.CameraModelType)
    with pytest.raises(UserError, match=r"put nvcc on the PATH.*rasterizer torch"):
        make_rasterizer("auto", DEVICE)
    monkeypatch.setattr(render, "self_check", lambda *_: TorchRasterizer.missing)
    with pytest.raises(AttributeError, match="missing"):
        make_rasterizer("auto", DEVICE)
