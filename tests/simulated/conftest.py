"""What tests on the simulated device share."""

import pytest

from tests.reference.gsplat_stand_ins import lent
from tests.reference.scenes import Photos, random_gaussians, ring_of_views
from tests.reference.simulated_device import simulated_device


@pytest.fixture
def counts():
    """The simulated device, for the whole test."""
    with simulated_device() as counts:
        yield counts


@pytest.fixture
def simulated_gsplat(counts):
    """The same, with gsplat's functions."""
    with lent():
        yield counts


@pytest.fixture(scope="module")
def views():
    return ring_of_views(5)


@pytest.fixture(scope="module")
def photos(views):
    return Photos(random_gaussians(150, seed=7, size=0.12), views)


@pytest.fixture
def start():
    return random_gaussians(120, seed=1, size=0.12)
