import pytest

from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.cuda.backend import GsplatRasterizer
from abcd_ns.engine.train.step import batch
from tests.engine.conftest import make, photos, start, views
from tests.reference.gsplat_stand_ins import lent
from tests.reference.simulated_device import DEVICE, simulated_device

__all__ = ["counts", "make", "on_device", "photos", "simulated_gsplat", "start", "views"]


@pytest.fixture
def counts():
    with simulated_device() as counts:
        yield counts


@pytest.fixture
def simulated_gsplat(counts):
    with lent():
        yield counts


@pytest.fixture
def on_device(simulated_gsplat, make):  # noqa: ARG001 - which is what they need
    """Makes runs on it, with gsplat (without its check) unless told otherwise."""

    def made(name: str = "run", rasterizer: str = "gsplat", **options):
        draws = TorchRasterizer(use_native=False) if rasterizer == "torch" else GsplatRasterizer()
        return make(name, device=DEVICE, rasterizer=draws, **options)

    return made


@pytest.fixture(autouse=True, scope="package")
def _few_backgrounds():
    """Runs are short, and each draws those of thousands of steps at once: half a second here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "BACKGROUNDS", 64)
        yield
