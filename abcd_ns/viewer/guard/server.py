"""Puts the rules in front of every viser server that this process starts."""

import importlib
import sys
import warnings
from collections import ChainMap
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from importlib.metadata import version
from typing import Any

import msgspec
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from abcd_ns.viewer.guard.rules import Rules, content_policy

UNREADABLE = (AssertionError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""What viser's deserialisation raises on frames that are no message, beside msgspec's own errors."""

REMEDY = (
    b"403: the viewer does not answer to this address. Open http://localhost with its port, or start it with "
    b"--viewer.websocket-host NAME, NAME being the host in the address."
)

_rules: dict[int, Rules] = {}
_told: set[str] = set()


def install() -> None:
    """Guard every viser server that starts from now on; print a warning if this viser is not 0.2."""
    importlib.import_module("viser")
    infra = sys.modules.get("viser.infra._infra")
    package = getattr(infra, "websockets", None)
    if isinstance(package, _Overlay):
        return
    if not hasattr(infra, "WebSocketServerProtocol") or not hasattr(package, "server"):
        CONSOLE.print(
            f"[bold yellow]warning:[/] the viewer is unguarded: viser {version('viser')} is built otherwise "
            "than 0.2. Use --vis tensorboard on a machine that others use, too."
        )
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of the older API, which is viser's choice
        serve = package.server.serve
    infra.websockets = _Overlay(package, server=_Overlay(package.server, serve=guarded(serve)))


def rules_of(server: Any) -> Rules | None:
    """The rules of a `viser.ViserServer`, which then know its GUI elements; None if it is unguarded."""
    rules = _rules.get(server.get_port())
    if rules is not None:
        rules.element = partial(_element, server)
    return rules


def _element(server: Any, name: str) -> Any:
    """The input element of the server's or of a client's GUI by its id; None if there is none."""
    guis = (server.gui, *(client.gui for client in server.get_clients().values()))
    return ChainMap(*(gui._gui_input_handle_from_id for gui in guis)).get(name)


def guarded(serve: Callable[..., Any]) -> Callable[..., Any]:
    """`websockets.server.serve` behind rules for the host it listens on."""

    def start(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        rules = _rules[port] = Rules(host)

        async def answer(path: str, headers: Any) -> Any:
            if (reason := rules.refusal(path, headers)) is not None:
                _tell(reason)
                return HTTPStatus.FORBIDDEN, {}, REMEDY
            found = await process_request(path, headers)
            if found is None:
                return None
            status, fields, content = found
            policy = content_policy(headers["Host"])
            extra = {"Content-Security-Policy": policy, "X-Content-Type-Options": "nosniff"}
            return status, {**fields, **extra}, content

        def read(connection: Any) -> Any:
            return handler(_Reader(connection, rules))

        return serve(read, host, port, process_request=answer, **options)

    return start


def read_message(frame: Any) -> Any:
    """A client's frame as viser's message; None if it is none."""
    from viser._messages import Message

    if not isinstance(frame, bytes):
        return None
    try:
        return Message.deserialize(frame)
    except (*UNREADABLE, msgspec.MsgspecError):
        return None


class _Overlay:
    """A module or package as it is, but for some names."""

    def __init__(self, original: Any, **instead: Any) -> None:
        self.__dict__.update(instead)
        self._original = original

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)


class _Reader(_Overlay):
    """A connection that passes on only frames that are messages and that the rules admit."""

    def __init__(self, connection: Any, rules: Rules) -> None:
        super().__init__(connection, _rules=rules)

    async def recv(self, *args: Any, **kwargs: Any) -> Any:
        while True:
            frame = await self._original.recv(*args, **kwargs)
            message = read_message(frame)
            if message is not None and self._rules.admits(message):
                return frame
            what = "a frame that is no message" if message is None else type(message).__name__
            if what == "GuiUpdateMessage":
                what = "a value that its control does not take (a name has letters, digits, '_', '-' and '.')"
            _tell(f"{what} is not acted on")


def _tell(reason: str) -> None:
    """Say once for each reason what was refused."""
    if reason not in _told and len(_told) < 20:
        _told.add(reason)
        CONSOLE.print(f"The viewer refused a request: {escape(reason)}.", highlight=False)
