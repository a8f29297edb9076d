import shutil
from pathlib import Path

import pytest

from abcd_ns.cli.check.survey import Survey, survey
from tests.cli.check.scenes import write_sound


@pytest.fixture(scope="session")
def sound(tmp_path_factory) -> Path:
    """Not to be written to."""
    return write_sound(tmp_path_factory.mktemp("check") / "scene")


@pytest.fixture
def scene(sound, tmp_path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(sound, tmp_path / "scene"))


@pytest.fixture(scope="session")
def found(sound) -> Survey:
    return survey(sound, 1)
