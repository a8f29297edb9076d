"""A small scene to train on, for the tests of training."""

import pytest

from tests.reference.scenes import Photos, random_gaussians, ring_of_views


@pytest.fixture(scope="module")
def views():
    return ring_of_views(5)


@pytest.fixture(scope="module")
def photos(views):
    return Photos(random_gaussians(150, seed=7, size=0.12), views)


@pytest.fixture
def start():
    return random_gaussians(120, seed=1, size=0.12)
