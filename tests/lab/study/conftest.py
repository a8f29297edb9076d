"""What studies are made of."""

from pathlib import Path

import pytest

from tests.reference.colmap_scene import write_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Path:
    """A tiny scene. Read only."""
    return write_scene(tmp_path_factory.mktemp("study") / "scene")
