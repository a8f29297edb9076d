"""The panel and the training lock; the rest on a real run in tests/nerfstudio/test_viewer.py."""

import threading
from types import SimpleNamespace

import pytest

from abcd_ns.engine.events import LayersDrawn, Pruning, StepTaken
from abcd_ns.viewer import panel as panel_module
from abcd_ns.viewer.panel import AbcdPanel


def watched_panel(browsers: int = 1) -> AbcdPanel:
    panel = AbcdPanel(SimpleNamespace(), list, lambda _: None)
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
    monkeypatch.setattr(panel_module, "HANDOVER_SECONDS", 0.5)
    monkeypatch.setattr(panel_module, "SECONDS_BETWEEN_UPDATES", seconds)
    assert draws_meanwhile(watched_panel(browsers), event) == draws
