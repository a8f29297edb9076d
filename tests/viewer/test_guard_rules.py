"""Who may talk to the viewer: the rules, without a server."""

import math
from types import SimpleNamespace

import pytest
from websockets.datastructures import Headers

from abcd_ns.viewer.guard import rules as rules_module
from abcd_ns.viewer.guard.rules import Rules, content_policy, is_camera, plain_path


def headers(host: str = "127.0.0.1:7007", origin: str | None = None) -> Headers:
    fields = [("Host", host)] + ([] if origin is None else [("Origin", origin)])
    return Headers(fields)


HOME = Rules("127.0.0.1")
EVERYWHERE = Rules("0.0.0.0")


KNOWN = ("127.0.0.1:7007", "localhost:8080", "LOCALHOST", "127.8.9.1", "[::1]:7007", "localhost.")
STRANGE = (
    *("evil.example", "evil.example:7007", "localhost.evil.example", "127.0.0.1.evil.example", "192.168.1.5"),
    *("0.0.0.0", "user@localhost", "localhost/..", "localhost localhost", "[::1", "[::2]", ""),
    "localhost:99999999",
)


def test_a_viewer_at_home_goes_by_the_names_of_this_machine_alone():
    assert [host for host in (*KNOWN, *STRANGE) if HOME.knows(host)] == list(KNOWN)


def test_a_name_that_was_configured_is_known():
    assert Rules("workstation").knows("workstation:7007")
    assert Rules("192.168.1.5").knows("192.168.1.5:7007")
    assert not Rules("workstation").knows("workstation.evil.example")


def test_a_viewer_on_all_networks_goes_by_addresses_and_own_names_alone(monkeypatch):
    monkeypatch.setattr(rules_module.socket, "gethostname", lambda: "Lab7.local")
    monkeypatch.setattr(rules_module.socket, "getfqdn", lambda: "lab7.example.org")
    rules_module._own_names.cache_clear()
    known = ["192.168.1.5:7007", "[fe80::1]:7007", "lab7:7007", "lab7.example.org", "lab7.local", "localhost"]
    assert [host for host in known if not EVERYWHERE.knows(host)] == []
    assert not EVERYWHERE.knows("rebound.evil.example:7007")
    assert Rules("lab7").knows("lab7.example.org:7007")
    assert not HOME.knows("lab7.example.org:7007")  # a stranger's network may have given us this name
    rules_module._own_names.cache_clear()


def test_the_tunnels_name_is_known_only_where_sharing_is_on():
    assert not HOME.knows("abc.share.viser.studio")
    assert Rules("127.0.0.1", share=True).knows("abc.share.viser.studio")
    assert not Rules("127.0.0.1", share=True).knows("share.viser.studio.evil.example")


def test_the_origin_must_be_the_viewers_own():
    own = [None, "http://127.0.0.1:7007", "https://127.0.0.1:7007", "HTTP://127.0.0.1:7007"]
    others = ["http://127.0.0.1:8080", "http://localhost:7007", "https://evil.example", "null", ""]
    assert [o for o in own + others if HOME.refusal("/", headers(origin=o)) is None] == own


def test_two_hosts_or_two_origins_are_one_too_many():
    twice = Headers([("Host", "localhost"), ("Host", "evil.example")])
    assert "Host" in HOME.refusal("/", twice)
    origins = Headers([("Host", "localhost"), ("Origin", "http://localhost"), ("Origin", "http://evil")])
    assert "Origin" in HOME.refusal("/", origins)
    assert "Host" in HOME.refusal("/", Headers())


FILES = ("/", "/?x=../..", "/index.html", "/assets/index-_lN.css", "/Inter-VariableFont_slnt,wght.ttf")
NO_FILES = (
    *(
        "/../secret",
        "/assets/../../secret",
        "/./secret",
        "/%2e%2e/secret",
        "/%2E%2E%2Fsecret",
        "/..%5csecret",
    ),
    *("/assets\\..\\secret", "/%252e%252e/secret", "/\u2024\u2024/secret", "/.git/config", "//etc/passwd"),
    *("etc/passwd", "http://127.0.0.1/index.html", "/assets/", "/a\0b", "/a\nb", ""),
)


def test_a_path_names_a_file_of_the_viewers_or_nothing():
    assert [path for path in (*FILES, *NO_FILES) if plain_path(path)] == list(FILES)


def test_a_refusal_quotes_a_stranger_harmlessly():
    reasons = [HOME.refusal("/\x1b[31m" + "x" * 500, headers()), HOME.refusal("/", headers("x" * 500))]
    assert "\x1b" not in reasons[0]
    assert max(map(len, reasons)) < 200


def camera(**changes):
    fields = {
        "wxyz": (1.0, 0.0, 0.0, 0.0),
        "position": (1.0, 2.0, 3.0),
        "look_at": (0.0, 0.0, 0.0),
        "up_direction": (0.0, 0.0, 1.0),
        "fov": 1.0,
        "aspect": 1.5,
    }
    return type("ViewerCameraMessage", (SimpleNamespace,), {})(**{**fields, **changes})


def test_a_camera():
    assert is_camera(camera())
    assert HOME.admits(camera())


@pytest.mark.parametrize(
    "changes",
    [
        {"wxyz": (1.0, 0.0, 0.0)},
        {"wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"wxyz": None},
        {"position": (math.nan, 0.0, 0.0)},
        {"position": "123"},
        {"position": {0: 1, 1: 2, 2: 3}},
        {"look_at": (1.0, "2", 3.0)},
        {"fov": 0.0},
        {"fov": math.pi},
        {"fov": "wide"},
        {"aspect": math.inf},
        {"aspect": 1e9},
        {"aspect": -1.0},
        {"aspect": [1.5]},
    ],
)
def test_no_camera(changes):
    assert not HOME.admits(camera(**changes))


def message(kind: str, **fields):
    return type(kind, (SimpleNamespace,), {})(**fields)


def test_sharing_takes_permission():
    for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
        assert not HOME.admits(message(kind))
        assert Rules("127.0.0.1", share=True).admits(message(kind))


ELEMENTS = {
    "switch": SimpleNamespace(value=False, disabled=False),
    "number": SimpleNamespace(value=4, disabled=False),
    "disabled": SimpleNamespace(value=4, disabled=True),
    "vector": SimpleNamespace(value=(1.0, 2.0), disabled=False),
    "choice": SimpleNamespace(value="a/b", disabled=False, options=("a/b", "c")),
    "text": SimpleNamespace(value="name", disabled=False),
    "upload": SimpleNamespace(value=SimpleNamespace(name="x"), disabled=False),
}
FITTING = {
    "switch": [True, False],
    "number": [3, 0.5],
    "vector": [[1, 2.5], (0, 0)],
    "choice": ["a/b", "c"],
    "text": ["2026-11-28-10-00-00", "Küche_2.final"],
}
UNFIT = {
    "switch": [1, "True", [True]],
    "number": ["nan", "1e999", math.nan, math.inf, 1e300, None, [1]],
    "disabled": [3],
    "vector": [[1], [1, 2, 3], ["1", "2"], [1, math.nan], 1, "12"],
    "choice": ["d", "../a", ["c"], 0],
    "text": [
        "/etc/x",
        "a/b",
        "..",
        ".x",
        "a\\b",
        "a\0b",
        "a\n",
        "-x",
        "a b",
        "$(x)",
        "",
        "x" * 101,
        5,
        ["a"],
    ],
    "upload": ["x", True],
    "unknown": [True],
}


@pytest.mark.parametrize("name", UNFIT)
def test_an_element_takes_values_of_its_kind_alone(name):
    rules = Rules("127.0.0.1", element=ELEMENTS.get)

    def admitted(value):
        return rules.admits(message("GuiUpdateMessage", id=name, updates={"value": value}))

    assert [value for value in FITTING.get(name, []) if not admitted(value)] == []
    assert [value for value in UNFIT[name] if admitted(value)] == []


def test_of_an_element_only_the_value_can_be_set():
    rules = Rules("127.0.0.1", element=ELEMENTS.get)
    for updates in ({"value": 3, "update_cb": []}, {"disabled": False}, {}, ["value"]):
        assert not rules.admits(message("GuiUpdateMessage", id="number", updates=updates))


def test_other_messages_are_not_acted_on():
    for kind in ("FileTransferStart", "FileTransferPart", "ScenePointerMessage", "GetRenderResponseMessage"):
        assert not HOME.admits(message(kind))
    assert HOME.admits(message("SceneNodeClickMessage", name="/crop"))
    pose = {"name": "/crop", "wxyz": (1, 0, 0, 0), "position": (0, 0, 0)}
    assert HOME.admits(message("TransformControlsUpdateMessage", **pose))
    for wrong in ({"wxyz": (0, 0, 0, 0)}, {"position": (math.nan, 0, 0)}):
        assert not HOME.admits(message("TransformControlsUpdateMessage", **{**pose, **wrong}))


def test_the_page_may_connect_to_its_own_server_alone():
    policy = content_policy(["127.0.0.1:7007"])
    assert "connect-src 'self' data: blob: ws://127.0.0.1:7007 wss://127.0.0.1:7007;" in policy
    assert "default-src 'self' " in policy
    assert "https:" not in policy
    assert "*" not in policy
