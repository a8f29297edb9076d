"""The guard before a real viser server: each of these requests is sent over a socket."""

import asyncio
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
from websockets.asyncio.client import connect as connect_async
from websockets.asyncio.server import serve as serve_async
from websockets.exceptions import InvalidStatus

from abcd_ns.viewer import guard
from abcd_ns.viewer.guard.server import guarded
from tests.viewer.client import CAMERA, Browser, ask, free_port, status

SECRET = b"the canary sings"


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    assert guard.install()
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


def paths_to(canary: Path) -> list[str]:
    up = "/.." * 20
    return [
        f"{up}{canary}",
        f"/assets{up}{canary}",
        f"{up.replace('.', '%2e')}{canary}",
        f"{up.replace('/', '%2f')}{canary}",
        f"{up.replace('/', chr(92))}{canary}".replace("/", "\\"),
        f"/{up}{canary}",
        f"/{canary}",
        f"{up}{canary}?x",
        f"/%00{canary}",
    ]


def test_no_path_leads_to_a_file_outside(server, canary):
    for path in paths_to(canary):
        answer = ask(server, path)
        assert SECRET not in answer, path
        assert status(answer) in (HTTPStatus.FORBIDDEN, HTTPStatus.BAD_REQUEST), path


@pytest.mark.skipif(
    not hasattr(_infra, "WebSocketServerProtocol"), reason="viser 1.0.25 refuses such paths itself"
)
def test_without_the_guard_the_canary_sings(canary, monkeypatch):
    monkeypatch.setattr(_infra, "websockets", _infra.websockets._original)
    bare = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
    assert SECRET in ask(bare, paths_to(canary)[0])
    bare.stop()


def test_the_page_is_served_and_told_to_stay_at_home(server):
    answer = ask(server, "/")
    assert status(answer) == HTTPStatus.OK
    head = answer.partition(b"\r\n\r\n")[0].decode()
    assert f"connect-src 'self' data: blob: ws://127.0.0.1:{server.get_port()} " in head
    assert "X-Content-Type-Options: nosniff" in head


def test_a_name_that_was_rebound_is_not_answered(server):
    host = "evil.example"
    assert status(ask(server, "/", Host=host)) == HTTPStatus.FORBIDDEN
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    answer = ask(server, "/", Host=host, **upgrade, **{"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="})
    assert status(answer) == HTTPStatus.FORBIDDEN


def test_a_foreign_pages_websocket_is_not_opened(server):
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


FRAMES = {
    "text": "hello",
    "nothing": b"",
    "noise": bytes(range(256)) * 4,
    "truncated": msgspec.msgpack.encode(CAMERA)[:-3],
    "an array that claims 4 G elements": b"\xdd\xff\xff\xff\xff",
    "nested 100,000 deep": b"\x91" * 100_000,
    "no map": msgspec.msgpack.encode([1, 2]),
    "no type": msgspec.msgpack.encode({"wxyz": 1}),
    "unknown type": msgspec.msgpack.encode({"type": "Evil"}),
    "a list as type": msgspec.msgpack.encode({"type": ["Evil"]}),
    "missing fields": msgspec.msgpack.encode({"type": "ViewerCameraMessage"}),
    "unknown fields": msgspec.msgpack.encode({**CAMERA, "evil": 1}),
    "NaN": msgspec.msgpack.encode({**CAMERA, "position": [float("nan")] * 3}),
    "three numbers for four": msgspec.msgpack.encode({**CAMERA, "wxyz": [1.0, 0.0, 0.0]}),
}


@pytest.mark.parametrize("what", FRAMES)
def test_a_malformed_frame_changes_nothing(server, browser, answers, what, capfd):
    browser.send(FRAMES[what])
    assert answers()
    clients = server.get_clients()
    client = clients[max(clients)]
    assert client.camera.position.tolist() == CAMERA["position"]
    assert "Traceback" not in "".join(capfd.readouterr())


def test_no_attribute_of_a_control_can_be_overwritten(server, browser, answers):
    slider = server.gui.add_slider("n", min=0, max=9, step=1, initial_value=4)
    for name in ("update_cb", "typ", "sync_cb"):
        browser.send({"type": "GuiUpdateMessage", "id": slider._impl.id, "updates": {name: "x"}})
    assert answers()
    assert slider._impl.update_cb == []
    assert slider.value == 4
    slider.remove()


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
    assert not guard.install()
    assert "unguarded" in capsys.readouterr().out


def test_the_newer_api_of_websockets_is_guarded_by_the_same_rules():
    frames = []

    async def handler(connection) -> None:
        frames.append(await connection.recv())
        await connection.send(b"done")

    def page(connection, request):
        upgrades = request.headers.get("Upgrade") == "websocket"
        return None if upgrades else connection.respond(HTTPStatus.OK, "page")

    async def get(port: int, path: str, host: str) -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        answer = await reader.read()
        writer.close()
        return answer

    async def scenario() -> None:
        port = free_port()
        serve = guarded(serve_async)
        async with serve(handler, "127.0.0.1", port, process_request=page):
            home = await get(port, "/", f"127.0.0.1:{port}")
            assert status(home) == HTTPStatus.OK
            assert b"Content-Security-Policy: default-src 'self'" in home
            assert status(await get(port, "/../etc/passwd", "localhost")) == HTTPStatus.FORBIDDEN
            assert status(await get(port, "/", "evil.example")) == HTTPStatus.FORBIDDEN
            with pytest.raises(InvalidStatus):
                await connect_async(f"ws://127.0.0.1:{port}", origin="https://evil.example")
            async with connect_async(f"ws://127.0.0.1:{port}") as client:
                for frame in ("text", b"\xc1", msgspec.msgpack.encode(CAMERA)):
                    await client.send(frame)
                assert await client.recv() == b"done"

    asyncio.run(scenario())
    assert frames == [msgspec.msgpack.encode(CAMERA)]
