from pathlib import Path

import pytest

from tests.data.dataparser_scenes import write_model, write_photos


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A small sound scene, COLMAP binary."""
    write_model(tmp_path / "scene/sparse/0")
    write_photos(tmp_path / "scene/images")
    return tmp_path / "scene"
