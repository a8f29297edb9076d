"""The rules: who may talk to the viewer, and about what.

A viewer on 127.0.0.1 is still open to every page in the user's browser: a page may connect a websocket to
any address (its Origin tells), and a name that its owner points at 127.0.0.1 makes the viewer look like the
page's own server (DNS rebinding; the Host header tells). A name in the Host header is trusted only if its
owner is us; an address needs no trust, since nobody can point an address elsewhere.
"""

import ipaddress
import math
import re
import socket
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

THIS_MACHINE = "127.0.0.1"
"""The host to listen on: reached from this machine alone."""
WILDCARDS = ("0.0.0.0", "::", "")
"""Hosts that a server binds to in order to be reached under all addresses of the machine."""
SHARE_DOMAIN = ".share.viser.studio"
"""Names under which viser's public tunnel makes a viewer available."""
ASPECTS = (0.01, 100.0)
"""Width over height of a window that pictures are drawn for."""
LARGEST = 1e9
"""Numbers of a client must be below this."""

_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+)(?::[0-9]{1,5})?")
# Every segment begins with something else than a dot. No percent sign, backslash, control character or //.
_PATH = re.compile(r"/|(/[A-Za-z0-9_~-][A-Za-z0-9_~.,-]*)+")
# It becomes a file's name, and part of a command to copy: no slash, space, leading dot or leading dash.
_TEXT = re.compile(r"\w[\w.-]{0,99}")


@dataclass
class Rules:
    """What one server answers to."""

    host: str
    """The name or address that it listens on."""
    share: bool = False
    """Whether viser's public tunnel may be used."""
    element: Callable[[str], Any] = lambda _: None
    """Returns a GUI element of viser's by its id, or None."""

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
    """A Content-Security-Policy by which the viewer's page talks to its own server alone.

    viser's page asks a tracker for a script, and nerfstudio's title bar its site for a picture.
    """
    return (
        "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "
        f"connect-src 'self' data: blob: ws://{host} wss://{host}; frame-ancestors 'none'; form-action 'none'"
    )


def _plain_name(name: str) -> str:
    return name.strip("[]").lower().rstrip(".")


def _quoted(values: Iterable[str]) -> str:
    """Values from a stranger as printable ASCII of bounded length."""
    return ", ".join(ascii(value[:80]) for value in values) or "(none)"
