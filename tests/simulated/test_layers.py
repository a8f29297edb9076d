"""Where layers lie on a device: there, in RAM, or nowhere; and what is copied for it."""

import pytest
import torch

from abcd_ns.engine.layers.layer_store import Kept, LayerStore
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.train.training_loop import train
from tests.reference.scenes import STILL, equal, whole_scene
from tests.reference.simulated_device import DEVICE

SIZE = 2 * 6 * 8 * 4 * 2
"""Bytes of a layer of `kept`."""


def kept() -> Kept:
    return Kept(torch.rand(2, 6, 8, 4, device=DEVICE).half(), None)


@pytest.fixture
def full(counts):
    """Room for two on the device and one in RAM; four were put."""
    store = LayerStore(DEVICE, 2 * SIZE, ram_bytes=SIZE)
    layers = [kept() for _ in range(4)]
    before = counts.copy()
    for view, one in enumerate(layers):
        store.put(view, one)
    return store, layers, counts, counts.since(before)


def test_one_has_no_room_and_one_goes_to_ram(full):
    store, layers, _, put = full
    assert (put.copies_to_host, put.bytes_to_host, put.copies_to_device) == (1, SIZE, 0)
    assert store.nbytes == 3 * SIZE
    assert store.get(3) is None
    for view in range(3):
        assert store.get(view).layers.device == DEVICE
        assert torch.equal(store.get(view).layers.cpu(), layers[view].layers.cpu())


def test_reading_copies_what_is_in_ram_and_waits_for_nothing(full):
    store, _, counts, _ = full
    before = counts.copy()
    for view in range(4):
        store.get(view)
    read = counts.since(before)
    assert (read.copies_to_device, read.bytes_to_device, read.waited, read.launches) == (1, SIZE, 0, 0)


def test_what_is_inside_the_window_goes_along(counts):
    store, interleaved = LayerStore(DEVICE, 0, ram_bytes=1 << 20), Splats(torch.rand(11, 5, device=DEVICE))
    store.put(0, Kept(kept().layers, interleaved))
    assert counts.copies_to_host == 2
    assert store.get(0).interleaved.planes.device == DEVICE
    assert torch.equal(store.get(0).interleaved.planes.cpu(), interleaved.planes.cpu())


def test_a_run_does_not_depend_on_where_its_layers_are(on_device, photos):
    scenes = []
    for name, on, ram in (
        ("device", 1 << 30, 0),
        ("RAM", 0, 1 << 30),
        ("each", 60_000, 60_000),
        ("none", 0, 0),
    ):
        options = {"layer_bytes": on, "layer_ram_bytes": ram, "density": STILL}
        coordinator = on_device(name, blocks=3, steps=6, **options)
        held = []
        coordinator.announce.subscribe(lambda _, c=coordinator, h=held: h.append(c.layer_bytes))
        train(coordinator, photos)
        assert (max(held) > 0) == (name != "none")
        assert max(held) <= coordinator.layer_limit == on + ram
        scenes.append(whole_scene(coordinator))
    assert all(equal(scenes[0], other) for other in scenes[1:])
