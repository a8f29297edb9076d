import pytest

from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views


@pytest.fixture(scope="module")
def views():
    return ring_of_views(5)


@pytest.fixture(scope="module")
def photos(views):
    return Photos(random_gaussians(150, seed=7, size=0.12), views)


@pytest.fixture
def start():
    return random_gaussians(120, seed=1, size=0.12)


@pytest.fixture
def make(tmp_path, views, start):
    """Makes runs of the scene, each in a folder of its own, or with `resume` in an earlier one's."""

    def made(name: str = "run", start=start, views=views, **options):
        (tmp_path / name).mkdir(exist_ok=True)
        return make_coordinator(tmp_path / name, start, views, **options)

    return made
