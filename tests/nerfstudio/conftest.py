from pathlib import Path

import pytest

from tests.reference.colmap_scene import write_scene


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """The folder of a tiny scene. Read only."""
    return write_scene(tmp_path_factory.mktemp("data") / "wall")
