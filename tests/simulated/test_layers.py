"""Where layers lie on a device: there, in RAM, or nowhere; and what is copied for it."""

import torch

from abcd_ns.engine.layers.layer_store import Kept, LayerStore
from abcd_ns.engine.render.projection import Splats
from tests.reference.simulated_device import DEVICE

SIZE = 2 * 6 * 8 * 4 * 2
"""Bytes of a layer of `kept`."""


def kept() -> Kept:
    return Kept(torch.rand(2, 6, 8, 4, device=DEVICE).half(), None)


def test_what_has_no_room_on_the_device_goes_to_ram_and_is_copied_once_when_read(counts):
    store = LayerStore(DEVICE, 2 * SIZE, ram_bytes=SIZE)
    layers = [kept() for _ in range(4)]
    before = counts.copy()
    for view, one in enumerate(layers):
        store.put(view, one)
    put, before = counts.since(before), counts.copy()
    assert (put.copies_to_host, put.bytes_to_host, put.copies_to_device) == (1, SIZE, 0)
    assert store.nbytes == 3 * SIZE
    found = [store.get(view) for view in range(4)]
    read = counts.since(before)
    assert (read.copies_to_device, read.bytes_to_device, read.waited, read.launches) == (1, SIZE, 0, 0)
    assert found[3] is None
    for one, given in zip(found[:3], layers, strict=False):
        assert one.layers.device == DEVICE
        assert torch.equal(one.layers.cpu(), given.layers.cpu())


def test_what_is_inside_the_window_goes_along(counts):
    store, interleaved = LayerStore(DEVICE, 0, ram_bytes=1 << 20), Splats(torch.rand(11, 5, device=DEVICE))
    store.put(0, Kept(kept().layers, interleaved))
    assert counts.copies_to_host == 2
    assert torch.equal(store.get(0).interleaved.planes.cpu(), interleaved.planes.cpu())
