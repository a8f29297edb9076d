"""nerfstudio's viewer on our runs: a real server, with a browser's side of the protocol connected to it."""

import io
import socket
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import psutil
import pytest
import torch
import viser.transforms as vtf
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.scripts.viewer import run_viewer
from nerfstudio.viewer.viewer import Viewer
from PIL import Image

from abcd_ns.nerfstudio.trainer import on_this_machine
from abcd_ns.nerfstudio.views import views_of
from abcd_ns.viewer.guard import rules_of
from abcd_ns.viewer.pictures import Choice, Show
from abcd_ns.viewer.scenery import COLORS
from abcd_ns.viewer.texts import Status
from tests.nerfstudio.test_training import configure, run
from tests.viewer.client import CAMERA, Browser, ask, free_port, status

STEPS, BLOCKS = 60, 3


def configure_viewer(data, out, **options):
    config = configure(data, out, steps=STEPS, blocks=BLOCKS, vis="viewer", **options)
    config.viewer.websocket_port = free_port()
    return config


def camera_of(pipeline) -> dict:
    """A client's camera where a training photo was taken."""
    view = views_of(pipeline.datamanager.train_dataset.cameras)[4]
    turn = vtf.SO3.from_matrix(view.viewmat[:3, :3].T.double().cpu().numpy())
    return {**CAMERA, "wxyz": turn.wxyz.tolist(), "position": (10 * view.center).tolist()}


class Watched:
    """A run that a browser watched from before its first step."""

    def __init__(self, config) -> None:
        config.set_timestamp()
        config.save_config()
        self.trainer = config.setup(local_rank=0, world_size=1)
        self.trainer.setup()
        self.server = self.trainer.viewer_state.viser_server
        self.browser = Browser(self.server, origin=f"http://127.0.0.1:{self.server.get_port()}")
        self.browser.send(CAMERA)
        self.browser.wait_for(lambda m: m["type"] == "SetCameraLookAtMessage")
        self.browser.send(camera_of(self.trainer.pipeline))
        self.trainer.train()

    def choose(self, label: str, value) -> None:
        control = self.browser.wait_for(lambda m: m.get("label") == label)
        self.browser.send({"type": "GuiUpdateMessage", "id": control["id"], "updates": {"value": value}})

    def picture(self, wanted, since: int = 0) -> np.ndarray:
        """The first picture that is as `wanted` says, the first `since` messages left out."""

        def fits(message) -> bool:
            return message["type"] == "BackgroundImageMessage" and wanted(pixels(message))

        return pixels(self.browser.wait_for(fits, since))


def pixels(message: dict) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(message["rgb_bytes"]))).astype(float)


def covered(picture: np.ndarray) -> float:
    """Share of a picture that is neither nearly black nor nearly the viewer's background."""
    background = np.array([38, 42, 55])
    return float(((np.abs(picture - background).max(axis=2) > 25) & (picture.max(axis=2) > 25)).mean())


@pytest.fixture(scope="module")
def watched(data, tmp_path_factory):
    connect = socket.socket.connect

    def at_home_only(self, address):
        """Neither training nor viewing needs a network."""
        if self.family in (socket.AF_INET, socket.AF_INET6) and address[0] not in ("127.0.0.1", "::1"):
            raise AssertionError(f"connects to {address}")
        return connect(self, address)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(socket.socket, "connect", at_home_only)
        watched = Watched(configure_viewer(data, tmp_path_factory.mktemp("out")))
    yield watched
    watched.browser.close()
    watched.trainer.pipeline.coordinator.scene.store.close()


def test_the_run_was_guarded_from_the_start(watched):
    assert rules_of(watched.server).host == "127.0.0.1"
    assert not rules_of(watched.server).share
    assert status(ask(watched.server, "/../../../../etc/hostname")) == 403
    themes = watched.browser.of("ThemeConfigurationMessage")
    assert themes[-1]["show_share_button"] is False
    assert "http" not in str(themes[-1]["titlebar_content"])


def test_every_block_has_its_box_and_the_active_one_was_marked(watched):
    drawn = [m for m in watched.browser.of("CatmullRomSplineMessage") if m["name"].startswith("/abcd/block_")]
    colors = {tuple(m["color"].to_bytes(3, "big")) for m in drawn}
    assert {COLORS[status] for status in (Status.WARM_UP, Status.ACTIVE, Status.DONE)} <= colors
    labels = {m["name"]: m["text"] for m in watched.browser.of("LabelMessage")}
    assert {f"/abcd/label_{b + 1}" for b in range(BLOCKS)} <= set(labels)
    last = {m["name"]: m["color"] for m in drawn}
    assert {f"/abcd/block_{b + 1}" for b in range(BLOCKS)} <= set(last)
    assert len(set(last.values())) == 1


def test_the_panel_reports_the_run(watched):
    updates = [m["updates"] for m in watched.browser.of("GuiUpdateMessage")]
    said = [update["markdown"] for update in updates if "markdown" in update]
    assert any("Warm-up of the whole scene" in text for text in said)
    assert any(text.startswith("**Block ") and " left" in text for text in said)
    assert any(text.endswith("visits are waiting") for text in said)
    assert any("| RAM |" in text and "| layers |" in text for text in said)
    table = [text for text in said if text.startswith("| # | state |")][-1]
    assert table.count("| done |") == BLOCKS
    assert any(text == "**Trained.**" for text in said)
    assert any("](data:image/svg+xml;base64," in text for text in said)


def test_the_viewer_opens_with_colours(watched):
    """With the first of the model's outputs, and not with one that costs more to draw."""
    control = watched.trainer.viewer_state.control_panel
    assert control.output_render == "rgb"
    assert control.split_output_render not in ("normals", "depth_median")


def test_the_user_sees_one_block_alone(watched):
    everything = covered(watched.picture(lambda picture: covered(picture) > 0.5))
    since = watched.browser.heard
    watched.choose("Block", "3")
    watched.choose("Show", Show.BLOCK.value)
    alone = covered(watched.picture(lambda picture: 0 < covered(picture) < 0.8 * everything, since))
    assert watched.trainer.pipeline.model.choice.block == 2
    since = watched.browser.heard
    watched.choose("Show", Show.COMPOSITE.value)
    assert covered(watched.picture(lambda picture: covered(picture) > 1.1 * alone, since)) > alone
    watched.choose("Show", Show.EVERYTHING.value)


def test_boxes_are_there_while_it_trains_and_afterwards_when_wanted(watched):
    def shows(visible: bool):
        node = ("SetSceneNodeVisibilityMessage", "/abcd/block_1", visible)
        return lambda m: (m["type"], m.get("name"), m.get("visible")) == node

    watched.browser.wait_for(shows(False))  # when it was trained
    since = watched.browser.heard
    watched.choose("Boxes", True)
    watched.browser.wait_for(shows(True), since)


def test_the_user_sees_the_photo_that_is_taken_nearest(watched):
    since = watched.browser.heard
    watched.choose("Nearest photo", True)
    watched.browser.wait_for(lambda m: "Training photo 5" in m.get("updates", {}).get("markdown", ""), since)
    watched.choose("Nearest photo", False)


def test_what_the_viewer_shows_changes_no_evaluation(watched):
    model = watched.trainer.pipeline.model
    camera, _ = next(iter(watched.trainer.pipeline.datamanager.fixed_indices_eval_dataloader))
    before = model.get_outputs_for_camera(camera)["rgb"]
    model.choice = Choice(Show.BLOCK, 0)
    after = model.get_outputs_for_camera(camera)["rgb"]
    model.choice = Choice()
    assert bool((before == after).all())


def test_ns_viewer_stays_on_this_machine_and_shows_blocks(watched, monkeypatch, request):
    seen = []

    class Seen(Viewer):
        def __init__(self, config, *args, **kwargs) -> None:
            super().__init__(config, *args, **kwargs)
            request.addfinalizer(self.viser_server.stop)
            seen.extend((config, self))

    monkeypatch.setattr(run_viewer, "ViewerState", Seen)
    monkeypatch.setattr(run_viewer, "time", SimpleNamespace(sleep=Mock(side_effect=KeyboardInterrupt)))
    config = watched.trainer.base_dir / "config.yml"
    monkeypatch.setattr("sys.argv", ["ns-viewer", "--load-config", str(config)])
    with pytest.raises(KeyboardInterrupt):
        run_viewer.RunViewer(load_config=config).main()  # up to where it would wait for ever
    config, viewer = seen
    assert ViewerConfig().websocket_host == "0.0.0.0"  # ns-viewer's own default
    assert config.websocket_host == "127.0.0.1"
    port = viewer.viser_server.get_port()
    sockets = psutil.Process().net_connections()
    assert {c.laddr.ip for c in sockets if c.laddr.port == port and not c.raddr} == {"127.0.0.1"}
    assert rules_of(viewer.viser_server).host == "127.0.0.1"
    browser = Browser(viewer.viser_server)
    choices = browser.wait_for(lambda m: m.get("label") == "Block")
    assert tuple(choices["options"]) == ("1",)
    browser.wait_for(lambda m: "options" in m.get("updates", {}) and len(m["updates"]["options"]) == BLOCKS)
    browser.wait_for(
        lambda m: m["type"] == "CatmullRomSplineMessage" and m["name"] == f"/abcd/block_{BLOCKS}"
    )
    browser.wait_for(lambda m: "| 3 | done |" in m.get("updates", {}).get("markdown", ""))
    browser.send(CAMERA)
    browser.wait_for(lambda m: m["type"] == "SetCameraLookAtMessage")
    browser.send(camera_of(viewer.pipeline))
    browser.wait_for(lambda m: m["type"] == "BackgroundImageMessage" and covered(pixels(m)) > 0.5)
    browser.close()


@pytest.mark.parametrize(
    ("host", "arguments", "expected"),
    [
        ("0.0.0.0", [], "127.0.0.1"),
        ("::", ["--load-config", "config.yml"], "127.0.0.1"),
        ("0.0.0.0", ["--viewer.websocket-host", "0.0.0.0"], "0.0.0.0"),
        ("0.0.0.0", ["--viewer.websocket_host=0.0.0.0"], "0.0.0.0"),
        ("192.168.1.5", [], "192.168.1.5"),
    ],
)
def test_other_networks_are_the_users_choice(host, arguments, expected):
    assert on_this_machine(ViewerConfig(websocket_host=host), arguments).websocket_host == expected


def test_a_viewer_that_fails_does_not_end_the_run(data, tmp_path, monkeypatch, capsys):
    errors = [KeyError(3), ValueError("wxyz"), TypeError("max_res"), RuntimeError("full"), AssertionError()]

    def fail(viewer: Viewer, step: int, *_: object) -> None:  # noqa: ARG001
        raise errors[step]

    monkeypatch.setattr(Viewer, "update_scene", fail)
    config = configure_viewer(data, tmp_path)
    config.max_num_iterations = len(errors)
    trainer = run(config)
    assert trainer.pipeline.coordinator.state.step == len(errors)
    assert capsys.readouterr().out.count("iewer failed") == len(errors)


def test_a_viewers_background_counts_only_where_the_run_leaves_it_open(watched, monkeypatch):
    model, color = watched.trainer.pipeline.model, torch.tensor([0.1, 0.9, 0.2])
    monkeypatch.setattr(model, "background_color", model.background_color)  # so that it is put back
    for option, taken in (("white", False), ("random", True)):
        monkeypatch.setattr(model.config, "background_color", option)
        model.set_background(color)
        assert (model.background_color is color) == taken
