"""A guard in front of viser's server: who may talk to the viewer, and about what.

viser 0.2.7, which nerfstudio 1.1.5 pins, serves any readable file through `GET /../..`, looks at neither
Origin nor Host, lets every client open a public tunnel, and leaves a client behind that sent a bad frame.

A viewer on 127.0.0.1 is still open to every page in the user's browser: a page may connect a websocket to
any address (its Origin tells), and a name that its owner points at 127.0.0.1 makes the viewer look like the
page's own server (DNS rebinding; the Host header tells). A name in the Host header is trusted only if its
owner is us; an address needs no trust, since nobody can point an address elsewhere.

`Rules` says what is admitted and knows no server. `install` puts it in place of `websockets.serve` in a
private module of viser's, as there is no hook.
"""

import importlib
import ipaddress
import math
import re
import socket
import sys
import warnings
from collections import ChainMap
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from http import HTTPStatus
from importlib.metadata import version
from typing import Any

import msgspec
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

THIS_MACHINE = "127.0.0.1"  # the host to listen on: reached from this machine alone
WILDCARDS = ("0.0.0.0", "::", "")  # hosts to bind to, to be reached under all addresses of the machine
SHARE_DOMAIN = ".share.viser.studio"  # names under which viser's public tunnel makes a viewer available
ASPECTS = (0.01, 100.0)  # width over height of a window that pictures are drawn for
LARGEST = 1e9  # numbers of a client must be below this

_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+)(?::[0-9]{1,5})?")
# Every segment begins with something else than a dot. No percent sign, backslash, control character or //.
_PATH = re.compile(r"/|(/[A-Za-z0-9_~-][A-Za-z0-9_~.,-]*)+")
# It becomes a file's name, and part of a command to copy: no slash, space, leading dot or leading dash.
_TEXT = re.compile(r"\w[\w.-]{0,99}")

UNREADABLE = (AssertionError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""What viser's deserialisation raises on frames that are no message, beside msgspec's own errors."""
REMEDY = (
    b"403: the viewer does not answer to this address. Open http://localhost with its port, or start it with "
    b"--viewer.websocket-host NAME, NAME being the host in the address."
)


@dataclass
class Rules:
    """What one server answers to."""

    host: str  # the name or address that it listens on
    share: bool = False  # whether viser's public tunnel may be used
    element: Callable[[str], Any] = lambda _: None  # returns a GUI element of viser's by its id, or None

    def refusal(self, path: str, headers: Any) -> str | None:
        """Why a request is refused, for a person to read; None if it is answered."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self.knows(hosts[0]):
            return f"the Host {_quoted(hosts)} is not this viewer's"
        # A browser sends the Origin with every websocket; what sends none is no page.
        own = (f"http://{hosts[0].lower()}", f"https://{hosts[0].lower()}")
        if origins and not (len(origins) == 1 and origins[0].lower() in own):
            return f"the Origin {_quoted(origins)} is another page's"
        if not plain_path(path):
            return f"the path {_quoted([path])} is not one of a viewer's file"
        return None

    def knows(self, host: str) -> bool:
        """Whether a Host header, with or without a port, names this server."""
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        name, configured = _plain_name(found.group(1)), _plain_name(self.host)
        if name in ("localhost", configured) and name not in WILDCARDS:
            return True
        with suppress(ValueError):  # it is a name
            return ipaddress.ip_address(name).is_loopback or configured in WILDCARDS
        if configured not in (THIS_MACHINE, "localhost") and name in _own_names():
            return True
        return self.share and name.endswith(SHARE_DOMAIN)

    def admits(self, message: Any) -> bool:
        """Whether to act on a client's message: only on those named here."""
        match type(message).__name__:
            case "ViewerCameraMessage":
                return is_camera(message)
            case "GuiUpdateMessage":
                # Browsers set values alone; viser would set any attribute of the element.
                known = isinstance(message.updates, dict) and set(message.updates) == {"value"}
                element = self.element(message.id) if known else None
                return element is not None and fits(element, message.updates["value"])
            case "TransformControlsUpdateMessage":
                return _is_vector(message.wxyz, 4) and any(message.wxyz) and _is_vector(message.position, 3)
            case "SceneNodeClickMessage":
                return True  # viser looks its name up; nerfstudio reads no more of it
            case "ShareUrlRequest" | "ShareUrlDisconnect":
                return self.share
        return False


def plain_path(path: str) -> bool:
    """Whether a request's path can name a file below the server's root, and nothing else."""
    return _PATH.fullmatch(path.partition("?")[0]) is not None


def fits(element: Any, value: Any) -> bool:
    """Whether a client may give a GUI element this value: it is enabled, and the value is of its kind."""
    match element.value:
        case _ if element.disabled:
            return False
        case bool():
            return isinstance(value, bool)
        case int() | float():
            return _is_number(value)
        case tuple():
            return _is_vector(value, len(element.value))
        case str() if (options := getattr(element, "options", None)) is not None:
            return value in options
        case str():
            return isinstance(value, str) and _TEXT.fullmatch(value) is not None
    return False


def is_camera(message: Any) -> bool:
    """Whether a camera message describes a camera; nerfstudio's training loop computes with it unseen."""
    vectors = message.wxyz, message.position, message.look_at, message.up_direction
    if not all(map(_is_vector, vectors, (4, 3, 3, 3))) or not _is_vector((message.fov, message.aspect), 2):
        return False
    turned = any(abs(x) > 1e-6 for x in message.wxyz)
    return turned and 0 < message.fov < math.pi and ASPECTS[0] <= message.aspect <= ASPECTS[1]


def _is_vector(values: Any, size: int) -> bool:
    return isinstance(values, (tuple, list)) and len(values) == size and all(map(_is_number, values))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and abs(value) < LARGEST


@cache
def _own_names() -> tuple[str, ...]:
    """Names of this machine; the full one may be asked of the network, so only where it may reach us."""
    own, full = _plain_name(socket.gethostname()), _plain_name(socket.getfqdn())
    short = own.partition(".")[0]
    return own, full, short, f"{short}.local"


def content_policy(host: str) -> str:
    """A Content-Security-Policy by which the viewer's page talks to its own server alone: viser's page asks a
    tracker for a script, and nerfstudio's title bar its site for a picture."""
    return (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
        f"connect-src 'self' data: blob: ws://{host} wss://{host}; frame-ancestors 'none'; form-action 'none'"
    )


def _plain_name(name: str) -> str:
    return name.strip("[]").lower().rstrip(".")


def _quoted(values: Iterable[str]) -> str:
    """Values from a stranger as printable ASCII of bounded length."""
    return ", ".join(ascii(value[:80]) for value in values) or "(none)"


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

    def element(name: str) -> Any:
        guis = (server.gui, *(client.gui for client in server.get_clients().values()))
        return ChainMap(*(gui._gui_input_handle_from_id for gui in guis)).get(name)

    rules = _rules.get(server.get_port())
    if rules is not None:
        rules.element = element
    return rules


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
            policy = {"Content-Security-Policy": content_policy(headers["Host"])}
            return status, {**fields, **policy, "X-Content-Type-Options": "nosniff"}, content

        def read(connection: Any) -> Any:
            return handler(_Reader(connection, _rules=rules))

        return serve(read, host, port, process_request=answer, **options)

    return start


def read_message(frame: Any) -> Any:
    """A client's frame as viser's message; None if it is none."""
    from viser._messages import Message

    with suppress(*UNREADABLE, msgspec.MsgspecError):
        return Message.deserialize(frame) if isinstance(frame, bytes) else None


class _Overlay:
    """A module or package as it is, but for some names."""

    def __init__(self, original: Any, **instead: Any) -> None:
        self.__dict__.update(instead)
        self._original = original

    def __getattr__(self, name: str) -> Any:
        return getattr(self._original, name)


class _Reader(_Overlay):
    """A connection that passes on only frames that are messages and that the rules admit."""

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
