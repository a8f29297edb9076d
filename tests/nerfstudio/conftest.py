from collections.abc import Callable
from pathlib import Path

import pytest

from abcd_ns.nerfstudio.trainer import AbcdTrainer
from tests.nerfstudio.test_training import configure, run
from tests.reference.colmap_scene import write_scene


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """The folder of a tiny scene. Read only."""
    return write_scene(tmp_path_factory.mktemp("data") / "wall")


@pytest.fixture(scope="session")
def trained(data, tmp_path_factory) -> AbcdTrainer:
    """A run that nothing disturbed. Read only."""
    return run(configure(data, tmp_path_factory.mktemp("out")))


@pytest.fixture
def said_at_exit(capsys) -> Callable[..., str]:
    """Calls a function that ends the process with an exit code; returns what it printed."""

    def call(function: Callable[..., object], *args: object, code: int = 2, **options: object) -> str:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            function(*args, **options)
        assert ended.value.code == code
        return "".join(capsys.readouterr())

    return call
