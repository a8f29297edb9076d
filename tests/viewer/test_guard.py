"""The guard before a real viser server: each of these requests is sent over a socket."""

import threading
import time
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path

import msgspec
import pytest
import viser
from nerfstudio.viewer.render_panel import populate_render_tab
from viser.infra import _infra
from websockets.exceptions import InvalidStatus

from abcd_ns.viewer import guard
from tests.viewer.client import CAMERA, Browser, ask, free_port, status

SECRET = b"the canary sings"


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    guard.install()
    server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    guard.rules_of(server)
    yield server
    server.stop()


@pytest.fixture
def browser(server) -> Iterator[Browser]:
    browser = Browser(server)
    browser.send(CAMERA)
    yield browser
    browser.close()


@pytest.fixture
def answers(server, browser):
    """Returns once the server has acted on all that the browser sent before."""
    heard = threading.Event()
    box = server.gui.add_checkbox("heard", initial_value=False)
    box.on_update(lambda _: heard.set())

    def wait() -> bool:
        browser.send({"type": "GuiUpdateMessage", "id": box._impl.id, "updates": {"value": not box.value}})
        return heard.wait(timeout=20)

    yield wait
    box.remove()


@pytest.fixture
def canary(tmp_path: Path) -> Path:
    path = tmp_path / "canary.txt"
    path.write_bytes(SECRET)
    return path


UP = "/.." * 20
"""From any folder to the root."""


def test_no_path_leads_to_a_file_outside(server, canary):
    for up in (UP, f"/assets{UP}", UP.replace(".", "%2e"), UP.replace("/", "%2f"), f"/{UP}", "/", "/%00"):
        answer = ask(server, f"{up}{canary}")
        assert SECRET not in answer, up
        assert status(answer) in (HTTPStatus.FORBIDDEN, HTTPStatus.BAD_REQUEST), up


def test_without_the_guard_the_canary_sings(canary, monkeypatch):
    monkeypatch.setattr(_infra, "websockets", _infra.websockets._original)
    bare = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    assert SECRET in ask(bare, f"{UP}{canary}")
    bare.stop()


def test_the_page_is_served_and_told_to_stay_at_home(server):
    answer = ask(server, "/")
    assert status(answer) == HTTPStatus.OK
    head, own = answer.partition(b"\r\n\r\n")[0].decode(), f"127.0.0.1:{server.get_port()}"
    assert f"connect-src 'self' data: blob: ws://{own} wss://{own};" in head
    assert "https:" not in head
    assert "X-Content-Type-Options: nosniff" in head


def test_strangers_are_not_answered(server):
    """A name that was rebound, and a websocket of a foreign page."""
    assert status(ask(server, "/", Host="evil.example")) == HTTPStatus.FORBIDDEN
    with pytest.raises(InvalidStatus) as refused:
        Browser(server, origin="https://evil.example")
    assert refused.value.response.status_code == HTTPStatus.FORBIDDEN


def test_no_client_opens_a_public_tunnel(server, browser, answers, monkeypatch):
    asked = threading.Event()
    monkeypatch.setattr(server, "request_share_url", lambda: asked.set())
    browser.send({"type": "ShareUrlRequest"})
    assert answers()
    assert not asked.is_set()
    monkeypatch.setattr(guard.rules_of(server), "share", True)
    browser.send({"type": "ShareUrlRequest"})
    assert asked.wait(timeout=20)


FRAMES = (
    *("hello", b"", bytes(range(256)) * 4, msgspec.msgpack.encode(CAMERA)[:-3]),
    b"\xdd\xff\xff\xff\xff",  # an array that claims 4 G elements
    b"\x91" * 100_000,  # nested that deep
    msgspec.msgpack.encode([1, 2]),
    *({"wxyz": 1}, {"type": "Evil"}, {"type": ["Evil"]}, {"type": "ViewerCameraMessage"}),
    *({**CAMERA, "evil": 1}, {**CAMERA, "position": [float("nan")] * 3}, {**CAMERA, "wxyz": [1.0, 0.0, 0.0]}),
)


def test_malformed_frames_change_nothing(server, browser, answers, capfd):
    for frame in FRAMES:
        browser.send(frame)
    assert answers()
    clients = server.get_clients()
    client = clients[max(clients)]
    assert client.camera.position.tolist() == CAMERA["position"]
    assert "Traceback" not in "".join(capfd.readouterr())


def test_no_client_writes_a_file_outside_the_folder_of_camera_paths(server, browser, answers, tmp_path):
    """nerfstudio's render panel writes DATA/camera_paths/NAME.json, with NAME as the client sends it."""
    victim = tmp_path / "manifest.json"
    victim.write_text("the run")
    populate_render_tab(server, Path("config.yml"), tmp_path / "data")
    browser.wait_for(lambda m: m.get("label") == "Generate Command")
    labelled = {m["label"]: m["id"] for m in list(browser.messages) if "label" in m and "id" in m}

    def set_to(label: str, value: object) -> None:
        browser.send({"type": "GuiUpdateMessage", "id": labelled[label], "updates": {"value": value}})

    for name in (str(victim.with_suffix("")), "../../manifest"):
        set_to("Render name", name)
        set_to("Generate Command", True)
        browser.wait_for(lambda m: m["type"] == "GuiModalMessage")
    assert victim.read_text() == "the run"
    set_to("Render name", "tour")
    set_to("Generate Command", True)
    tour = tmp_path / "data/camera_paths/tour.json"
    for _ in range(200):  # written after the server has answered
        if answers() and tour.exists():
            break
        time.sleep(0.1)
    assert tour.exists()


def test_another_viser_is_not_guarded_and_the_user_told(monkeypatch, capsys):
    monkeypatch.setattr(_infra, "websockets", object())
    guard.install()
    assert "unguarded" in capsys.readouterr().out
