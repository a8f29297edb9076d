"""The panel and the training lock; the rest on a real run in tests/nerfstudio/test_viewer.py."""

import threading
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from abcd_ns.engine.events import LayersDrawn, Pruning, StepTaken
from abcd_ns.engine.gaussians.initialize import cloud_from_points
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.viewer import panel as panel_module
from abcd_ns.viewer.panel import AbcdPanel
from abcd_ns.viewer.pictures import Choice


def watched_panel(browsers: int = 1) -> AbcdPanel:
    panel = AbcdPanel(SimpleNamespace(), list, lambda _: None)
    panel.viewer = SimpleNamespace(
        train_lock=threading.Lock(), render_statemachines=dict.fromkeys(range(browsers))
    )
    return panel


@pytest.mark.parametrize(
    ("browsers", "event", "seconds", "draws"),
    [
        (1, LayersDrawn(0, 1, 9), 0.0, True),
        (1, Pruning(1, 9), 0.0, True),
        (0, LayersDrawn(0, 1, 9), 0.0, False),  # to nobody
        (1, StepTaken(1, 0, 1, 20.0), 0.0, False),
        (1, LayersDrawn(0, 1, 9), 1e6, False),  # once a second at most
    ],
)
def test_the_lock_is_handed_over(monkeypatch, browsers, event, seconds, draws):
    """A thread that waits for it gets it while the training thread announces some events."""
    monkeypatch.setattr(panel_module, "HANDOVER_SECONDS", 0.5)
    monkeypatch.setattr(panel_module, "SECONDS_BETWEEN_UPDATES", seconds)
    panel, waits, had_it = watched_panel(browsers), threading.Event(), threading.Event()
    lock = panel.viewer.train_lock

    def draw() -> None:
        waits.set()
        with lock:
            had_it.set()

    with lock:
        thread = threading.Thread(target=draw)
        thread.start()
        waits.wait()
        panel(event)
        assert lock.locked()
        assert had_it.is_set() == draws
    thread.join()


def test_a_browser_that_was_open_before_the_panel_is_shown_the_scene_too():
    """As a page left open is, which connects as soon as the server listens."""
    client, viewer, points = MagicMock(), MagicMock(trainer=None, train_lock=None), torch.rand(50, 3)
    viewer.stats_markdown.order = 0.0
    viewer.viser_server.on_client_connect = lambda welcome: welcome(client)
    tree = build_kd(points, 2)
    scene = MemoryScene(tree, cloud_from_points(points, 255 * points, sh_degree=0).gaussians())
    model = MagicMock(tree=tree, scene=lambda: scene, choice=Choice())
    AbcdPanel(model, list, lambda _: None)._setup(viewer)
    assert isinstance(client.camera.look_at, np.ndarray)


@pytest.mark.parametrize(
    ("finished", "waiting", "said"),
    [(True, 2, ""), (False, 2, "Epoch 0: 2 visits are waiting"), (False, 1, "Epoch 0: 1 visit is waiting")],
)
def test_visits_wait_until_the_run_ends(monkeypatch, finished, waiting, said):
    """One that ends by its time may end within an epoch."""
    monkeypatch.setattr(panel_module, "curve_image", lambda *_: "")
    panel = watched_panel()
    panel.viewer.update_step = panel._where = lambda _: None
    panel._controls, panel._log = MagicMock(), MagicMock()
    state = SimpleNamespace(step=0, epoch=0, queue=[None] * waiting)
    panel._report(SimpleNamespace(state=state, progress=0.5, finished=finished, config=MagicMock(), views=()))
    assert panel._controls.write.call_args_list[0].kwargs["epoch"] == said
