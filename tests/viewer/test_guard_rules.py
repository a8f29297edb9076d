"""Who may talk to the viewer: the rules, without a server."""

import math
from types import SimpleNamespace

import pytest
from websockets.datastructures import Headers

from abcd_ns.viewer import guard
from abcd_ns.viewer.guard import Rules, plain_path
from tests.viewer.client import CAMERA


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


@pytest.mark.parametrize(
    ("rules", "known", "strange"),
    [
        (Rules("workstation"), "workstation:7007", "workstation.evil.example"),
        (Rules("192.168.1.5"), "192.168.1.5:7007", "192.168.1.6"),
        (Rules("127.0.0.1", share=True), "a.share.viser.studio", "share.viser.studio.evil.example"),
    ],
)
def test_what_was_configured_is_known(rules, known, strange):
    assert [host for host in (known, strange) if rules.knows(host)] == [known]
    assert not HOME.knows(known)


def test_a_viewer_on_all_networks_goes_by_addresses_and_own_names_alone(monkeypatch):
    monkeypatch.setattr(guard.socket, "gethostname", lambda: "Lab7.local")
    monkeypatch.setattr(guard.socket, "getfqdn", lambda: "lab7.example.org")
    guard._own_names.cache_clear()
    known = ["192.168.1.5:7007", "[fe80::1]:7007", "lab7:7007", "lab7.example.org", "lab7.local", "localhost"]
    assert [host for host in known if not EVERYWHERE.knows(host)] == []
    assert not EVERYWHERE.knows("rebound.evil.example:7007")
    assert Rules("lab7").knows("lab7.example.org:7007")
    assert not HOME.knows("lab7.example.org:7007")  # a stranger's network may have given us this name
    guard._own_names.cache_clear()


def test_the_origin_must_be_the_viewers_own():
    own = [None, "http://127.0.0.1:7007", "https://127.0.0.1:7007", "HTTP://127.0.0.1:7007"]
    others = ["http://127.0.0.1:8080", "http://localhost:7007", "https://evil.example", "null", ""]
    assert [o for o in own + others if HOME.refusal("/", headers(origin=o)) is None] == own
    home, evil = "http://127.0.0.1:7007", ("Origin", "http://evil")
    assert "Origin" in HOME.refusal("/", Headers([*headers(origin=home).raw_items(), evil]))
    assert "Host" in HOME.refusal("/", Headers([("Host", "localhost"), ("Host", "evil.example")]))
    assert "Host" in HOME.refusal("/", Headers())


FILES = ("/", "/?x=../..", "/index.html", "/assets/index-_lN.css", "/Inter-VariableFont_slnt,wght.ttf")
NO_FILES = (
    *("/../secret", "/assets/../../secret", "/./secret", "/%2e%2e/secret", "/%2E%2E%2Fsecret"),
    *("/..%5csecret", "/assets\\..\\secret", "/%252e%252e/secret", "/\u2024\u2024/secret", "/.git/config"),
    *("//etc/passwd", "etc/passwd", "http://127.0.0.1/index.html", "/assets/", "/a\0b", "/a\nb", ""),
)


def test_a_path_names_a_file_of_the_viewers_or_nothing():
    assert [path for path in (*FILES, *NO_FILES) if plain_path(path)] == list(FILES)


def test_a_refusal_quotes_a_stranger_harmlessly():
    reasons = [HOME.refusal("/\x1b[31m" + "x" * 500, headers()), HOME.refusal("/", headers("x" * 500))]
    assert "\x1b" not in reasons[0]
    assert max(map(len, reasons)) < 200


ELEMENTS = {
    "switch": SimpleNamespace(value=False, disabled=False),
    "number": SimpleNamespace(value=4, disabled=False),
    "disabled": SimpleNamespace(value=4, disabled=True),
    "vector": SimpleNamespace(value=(1.0, 2.0), disabled=False),
    "choice": SimpleNamespace(value="a/b", disabled=False, options=("a/b", "c")),
    "text": SimpleNamespace(value="name", disabled=False),
    "upload": SimpleNamespace(value=SimpleNamespace(name="x"), disabled=False),
}


TAKEN = {
    "switch": [True, False],
    "number": [3, 0.5],
    "vector": [[1, 2.5], (0, 0)],
    "choice": ["a/b", "c"],
    "text": ["2026-11-28-10-00-00", "Küche_2.final"],
}
NOT_TAKEN = {
    "switch": [1, "True", [True]],
    "number": ["nan", "1e999", math.nan, math.inf, 1e300, None, [1]],
    "disabled": [3],
    "vector": [[1], [1, 2, 3], ["1", "2"], [1, math.nan], 1, "12"],
    "choice": ["d", "../a", ["c"], 0],
    "text": [
        *("/etc/x", "a/b", "..", ".x", "a\\b", "a\0b", "a\n", "-x", "a b", "$(x)", "", "x" * 101, 5, ["a"])
    ],
    "upload": ["x", True],
    "unknown": [True],
}


def admits(kind: str, rules: Rules = HOME, **fields) -> bool:
    """Whether a message of this kind is acted on."""
    return rules.admits(type(kind, (SimpleNamespace,), {})(**fields))


def test_an_element_takes_values_of_its_kind_alone():
    rules = Rules("127.0.0.1", element=ELEMENTS.get)

    def sets(name: str, updates) -> bool:
        return admits("GuiUpdateMessage", rules, id=name, updates=updates)

    assert [(n, v) for n, values in TAKEN.items() for v in values if not sets(n, {"value": v})] == []
    assert [(n, v) for n, values in NOT_TAKEN.items() for v in values if sets(n, {"value": v})] == []
    for updates in ({"value": 3, "update_cb": []}, {"disabled": False}, {}, ["value"]):
        assert not sets("number", updates)


def test_a_camera_is_one():
    camera = {key: value for key, value in CAMERA.items() if key != "type"}
    assert admits("ViewerCameraMessage", **camera)
    for name, values in {
        "wxyz": [(1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), None],
        "position": [(math.nan, 0.0, 0.0), "123", {0: 1, 1: 2, 2: 3}],
        "look_at": [(1.0, "2", 3.0)],
        "fov": [0.0, math.pi, "wide"],
        "aspect": [math.inf, 1e9, -1.0, [1.5]],
    }.items():
        assert [value for value in values if admits("ViewerCameraMessage", **{**camera, name: value})] == []


def test_only_messages_that_are_needed_are_acted_on():
    for kind in ("FileTransferStart", "FileTransferPart", "ScenePointerMessage", "GetRenderResponseMessage"):
        assert not admits(kind)
    for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
        assert not admits(kind)
        assert admits(kind, Rules("127.0.0.1", share=True))
    assert admits("SceneNodeClickMessage", name="/crop")
    pose = {"name": "/crop", "wxyz": (1, 0, 0, 0), "position": (0, 0, 0)}
    assert admits("TransformControlsUpdateMessage", **pose)
    for wrong in ({"wxyz": (0, 0, 0, 0)}, {"position": (math.nan, 0, 0)}):
        assert not admits("TransformControlsUpdateMessage", **{**pose, **wrong})
