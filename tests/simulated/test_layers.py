"""Where layers lie on a device: there, in RAM, or nowhere; and what is copied for it."""

import torch

from abcd_ns.engine.layers.layer_store import Kept, LayerStore
from abcd_ns.engine.render.projection import Splats
from tests.reference.simulated_device import DEVICE


def kept() -> Kept:
    return Kept(torch.rand(2, 6, 8, 4, device=DEVICE).half(), Splats(torch.rand(11, 5, device=DEVICE)))


def test_what_has_no_room_on_the_device_goes_to_ram_and_is_copied_once_when_read(counts):
    """Layers, and what is inside the window."""
    layers = [kept() for _ in range(4)]
    size = layers[0].nbytes
    store = LayerStore(DEVICE, 2 * size, ram_bytes=size)
    before = counts.copy()
    for view, one in enumerate(layers):
        store.put(view, one)
    put, before = counts.since(before), counts.copy()
    assert (put.copies_to_host, put.bytes_to_host, put.copies_to_device) == (2, size, 0)
    assert store.nbytes == 3 * size
    found = [store.get(view) for view in range(4)]
    read = counts.since(before)
    assert (read.copies_to_device, read.bytes_to_device, read.waited) == (2, size, 0)
    assert found[3] is None
    for one, given in zip(found[:3], layers, strict=False):
        assert one.layers.device == DEVICE
        assert torch.equal(one.layers.cpu(), given.layers.cpu())
        assert torch.equal(one.interleaved.planes.cpu(), given.interleaved.planes.cpu())
