"""Puts the rules in front of every viser server that this process starts.

viser 0.2.7, which nerfstudio 1.1.5 pins, serves any readable file through `GET /../..`, looks at neither
Origin nor Host, lets every client open a public tunnel, and leaves a client behind that sent a bad frame.
From 1.0.25 on it refuses such paths; the rest is as it was. Neither has a hook, so `install` gives viser's
module another `websockets.serve`: one that asks first, and reads frames before viser does.
"""

import sys
import warnings
from collections.abc import Awaitable, Callable
from http import HTTPStatus
from importlib.metadata import version
from typing import Any

import msgspec
import viser
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from abcd_ns.viewer.request_rules import Headers, Rules, content_policy

UNREADABLE = (
    AssertionError,
    AttributeError,
    LookupError,
    RecursionError,
    TypeError,
    ValueError,
    msgspec.MsgspecError,
)
"""What viser's deserialisation raises on frames that are no message."""

_rules: dict[int, Rules] = {}
_told: set[str] = set()


def install() -> bool:
    """Guard every viser server that is started from now on; harmless when done again.

    Returns:
        Whether they are guarded. If not, a warning was printed: this viser is built otherwise.
    """
    # Its private module: looked up late and by name, so that another viser costs a warning and no import.
    infra = sys.modules.get("viser.infra._infra")
    package = getattr(infra, "websockets", None)
    if isinstance(package, _Overlay):
        return True
    if hasattr(infra, "WebSocketServerProtocol") and hasattr(package, "server"):  # viser 0.2
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of the older API, which is viser's choice
            serve = package.server.serve
        server = _Overlay(package.server, serve=guard_legacy(serve))
        infra.websockets = _Overlay(package, server=server)
    elif hasattr(infra, "ServerConnection") and hasattr(package, "asyncio"):  # viser 1
        server = _Overlay(package.asyncio.server, serve=guard_asyncio(package.asyncio.server.serve))
        infra.websockets = _Overlay(package, asyncio=_Overlay(package.asyncio, server=server))
    else:
        found = version("viser")
        CONSOLE.print(
            f"[bold yellow]warning:[/] the viewer is unguarded: viser {found} is built otherwise "
            "than the versions that are known. Use --vis tensorboard on a machine that others use, too."
        )
        return False
    return True


def rules_of(server: viser.ViserServer) -> Rules | None:
    """The rules of a running server; None if it was started before `install`."""
    return _rules.get(server.get_port())


def guard_legacy(serve: Callable[..., Any]) -> Callable[..., Any]:
    """`serve` of websockets' older API, which viser 0.2 uses, behind rules for the host it listens on."""

    def guarded(handler: Any, host: str, port: int, *, process_request: Any = None, **options: Any) -> Any:
        rules = _rules[port] = Rules(host)

        async def answer(path: str, headers: Headers) -> Any:
            reason = rules.refusal(path, headers)
            if reason is not None:
                _tell(reason)
                return HTTPStatus.FORBIDDEN, {}, b"403"
            found = None if process_request is None else await process_request(path, headers)
            if found is None:
                return None
            status, fields, body = found
            return status, {**fields, **_page_headers(headers)}, body

        return serve(_reading(handler, rules), host, port, process_request=answer, **options)

    return guarded


def guard_asyncio(serve: Callable[..., Any]) -> Callable[..., Any]:
    """`serve` of websockets' newer API, which viser 1 uses, behind rules for the host it listens on."""

    def guarded(handler: Any, host: str, port: int, *, process_request: Any = None, **options: Any) -> Any:
        rules = _rules[port] = Rules(host)

        def answer(connection: Any, request: Any) -> Any:
            reason = rules.refusal(request.path, request.headers)
            if reason is not None:
                _tell(reason)
                return connection.respond(HTTPStatus.FORBIDDEN, "403")
            found = None if process_request is None else process_request(connection, request)
            if found is not None:
                for name, value in _page_headers(request.headers).items():
                    found.headers[name] = value
            return found

        return serve(_reading(handler, rules), host, port, process_request=answer, **options)

    return guarded


def read_message(frame: Any) -> Any:
    """A client's frame as viser's message; None if it is none."""
    if not isinstance(frame, bytes):
        return None
    try:
        return viser._messages.Message.deserialize(frame)
    except UNREADABLE:
        return None


class _Overlay:
    """A module or package as it is, but for some names."""

    def __init__(self, original: Any, **instead: Any) -> None:
        self.__dict__.update(instead)
        self._original = original

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)


class _Reader:
    """A connection that passes on only frames that are messages and that the rules admit."""

    def __init__(self, connection: Any, rules: Rules) -> None:
        self._connection, self._rules = connection, rules

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self, *args: Any, **kwargs: Any) -> Any:
        while True:
            frame = await self._connection.recv(*args, **kwargs)
            message = read_message(frame)
            if message is not None and self._rules.admits(message):
                return frame
            what = "a frame that is no message" if message is None else type(message).__name__
            _tell(f"{what} is not acted on")


def _reading(handler: Callable[[Any], Awaitable[None]], rules: Rules) -> Callable[[Any], Awaitable[None]]:
    async def handle(connection: Any) -> None:
        await handler(_Reader(connection, rules))

    return handle


def _page_headers(headers: Headers) -> dict[str, str]:
    policy = content_policy(headers.get_all("Host"))
    return {"Content-Security-Policy": policy, "X-Content-Type-Options": "nosniff"}


def _tell(reason: str) -> None:
    """Say once for each reason what was refused."""
    if reason not in _told and len(_told) < 20:
        _told.add(reason)
        CONSOLE.print(f"The viewer refused a request: {escape(reason)}.", highlight=False)
