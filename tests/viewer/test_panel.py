"""The panel and the training lock; the rest on a real run in tests/nerfstudio/test_viewer.py."""

import threading
from types import SimpleNamespace

import pytest

from abcd_ns.engine.events import LayersDrawn, StepTaken
from abcd_ns.viewer import panel as panel_module
from abcd_ns.viewer.panel import AbcdPanel


def watched_panel(browsers: int = 1) -> AbcdPanel:
    panel = AbcdPanel(SimpleNamespace(), list)
    panel.viewer = SimpleNamespace(
        train_lock=threading.Lock(), render_statemachines=dict.fromkeys(range(browsers))
    )
    return panel


def draws_meanwhile(panel: AbcdPanel, event) -> bool:
    """Whether a thread that waits for the lock gets it while the training thread announces `event`."""
    lock, waits, had_it = panel.viewer.train_lock, threading.Event(), threading.Event()

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
        meanwhile = had_it.is_set()
    thread.join()
    return meanwhile


def test_browsers_get_a_picture_while_layers_are_drawn(monkeypatch):
    monkeypatch.setattr(panel_module, "HANDOVER_SECONDS", 0.5)
    assert draws_meanwhile(watched_panel(), LayersDrawn(0, 1, 9))


@pytest.mark.parametrize(
    ("browsers", "event"),
    [(0, LayersDrawn(0, 1, 9)), (1, StepTaken(1, 0, 1, 20.0))],
    ids=["nobody", "a step"],
)
def test_otherwise_the_lock_is_kept(browsers, event, monkeypatch):
    monkeypatch.setattr(panel_module, "HANDOVER_SECONDS", 0.5)
    assert not draws_meanwhile(watched_panel(browsers), event)


def test_one_picture_a_second_at_most(monkeypatch):
    monkeypatch.setattr(panel_module, "HANDOVER_SECONDS", 0.5)
    panel = watched_panel()
    panel._updated = panel_module.time.monotonic()
    monkeypatch.setattr(panel_module, "SECONDS_BETWEEN_UPDATES", 1e6)
    assert not draws_meanwhile(panel, LayersDrawn(0, 1, 9))
