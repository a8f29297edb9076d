"""What the terminal says about reaching the viewer."""

import pytest

from abcd_ns.viewer import texts
from abcd_ns.viewer.texts import reach


@pytest.fixture
def container(tmp_path, monkeypatch):
    """The mark of a container, which is not there yet."""
    mark = tmp_path / ".dockerenv"
    monkeypatch.setattr(texts, "CONTAINER_MARKS", (tmp_path / "other", mark))
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    return mark


def test_a_viewer_in_a_container_names_the_flag_that_opens_it(container):
    assert reach("127.0.0.1") is None
    container.touch()
    assert "--viewer.websocket-host 0.0.0.0" in reach("127.0.0.1")
    assert "\n" not in reach("localhost")


@pytest.mark.parametrize("host", ["0.0.0.0", "10.0.0.5", "::"])
def test_one_that_is_open_needs_no_word(container, host):
    container.touch()
    assert reach(host) is None


def test_kubernetes_leaves_no_file(container, monkeypatch):
    monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "10.0.0.1")
    assert not container.exists()
    assert reach("127.0.0.1") is not None
