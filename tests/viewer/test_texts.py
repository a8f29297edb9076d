"""What the terminal says about reaching the viewer."""

import pytest

from abcd_ns.viewer import texts
from abcd_ns.viewer.texts import reach


@pytest.mark.parametrize("mark", [None, "a file", "Kubernetes"])
def test_a_viewer_in_a_container_names_the_flag_that_opens_it(tmp_path, monkeypatch, mark):
    monkeypatch.setattr(texts, "CONTAINER_MARKS", (tmp_path / "other", tmp_path / ".dockerenv"))
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    if mark == "a file":
        (tmp_path / ".dockerenv").touch()
    if mark == "Kubernetes":
        monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "10.0.0.1")
    for host in ("127.0.0.1", "localhost"):
        assert ("--viewer.websocket-host 0.0.0.0" in (reach(host) or "")) == (mark is not None)
    assert [reach(host) for host in ("0.0.0.0", "10.0.0.5", "::")] == [None] * 3  # they are open
