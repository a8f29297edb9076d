"""A browser's side of viser's protocol, for tests: raw requests, frames, and what the server sent."""

import socket
import threading
from typing import Any

import msgspec
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, -40.0],
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, -1.0, 0.0],
    "fov": 0.8,
    "aspect": 1.5,
}


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def ask(server: viser.ViserServer, path: str, **headers: str) -> bytes:
    """The answer to a GET whose path is sent as it is; `headers` replace or add to Host."""
    fields = {"Host": f"127.0.0.1:{server.get_port()}", "Connection": "close", **headers}
    lines = [f"GET {path} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items()), "", ""]
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=20) as raw:
        raw.sendall("\r\n".join(lines).encode("latin-1"))
        answer = b""
        while chunk := raw.recv(1 << 16):
            answer += chunk
    return answer


def status(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


class Browser:
    """A client that keeps all that the server sends."""

    def __init__(self, server: viser.ViserServer, **options: Any) -> None:
        self.messages: list[dict[str, Any]] = []
        self._news = threading.Condition()
        uri = f"ws://127.0.0.1:{server.get_port()}"
        self._socket = connect(uri, max_size=None, open_timeout=20, **options)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def send(self, message: dict[str, Any] | bytes | str) -> None:
        """Send a message, or a frame as it is."""
        self._socket.send(msgspec.msgpack.encode(message) if isinstance(message, dict) else message)

    @property
    def heard(self) -> int:
        with self._news:
            return len(self.messages)

    def wait_for(self, wanted: Any, since: int = 0, seconds: float = 60.0) -> dict[str, Any]:
        """The first message for which `wanted` is true, the first `since` messages left out."""
        with self._news:
            found = self._news.wait_for(
                lambda: next(filter(wanted, self.messages[since:]), None), timeout=seconds
            )
        assert found is not None, f"none of {len(self.messages)} messages was it"
        return found

    def of(self, kind: str) -> list[dict[str, Any]]:
        with self._news:
            return [message for message in self.messages if message["type"] == kind]

    def close(self) -> None:
        self._socket.close()
        self._thread.join(timeout=20)

    def _listen(self) -> None:
        try:
            for frame in self._socket:
                window = msgspec.msgpack.decode(frame)
                with self._news:
                    self.messages += window
                    self._news.notify_all()
        except ConnectionClosed:
            return
