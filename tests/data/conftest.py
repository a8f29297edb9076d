from pathlib import Path

import pytest

from tests.data.dataparser_scenes import write_capture


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A small sound scene, COLMAP binary."""
    write_capture(tmp_path / "scene")
    return tmp_path / "scene"
