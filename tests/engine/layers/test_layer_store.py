"""Layers are kept under limits, rounded the same wherever they lie, and drawn anew where there is no room."""

import pytest
import torch

from abcd_ns.engine.layers import visit_layers as visit
from abcd_ns.engine.layers.layer_store import Kept, LayerStore, packed, rounded
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.train.training_loop import train

CPU = torch.device("cpu")


def kept(height: int = 5, width: int = 7, interleaved: Splats | None = None) -> Kept:
    return Kept(rounded(torch.rand(2, height, width, 4)), interleaved)


def test_rounding_keeps_eleven_bits_and_nothing_and_everything():
    layers = torch.rand(2, 50, 40, 4) * torch.tensor([1.0, 1.0, 300.0, 1.0])
    half = rounded(layers)
    assert half.dtype == torch.float16
    assert float(((half.float() - layers) / layers).abs().max()) <= 2**-11
    exact = torch.tensor([0.0, 1.0]).expand(2, 3, 2, 2).reshape(2, 3, 1, 4)
    assert torch.equal(rounded(exact).float(), exact)
    assert torch.equal(rounded(layers.double()), layers.double())
    assert torch.equal(rounded(torch.full((2, 1, 1, 4), 1e6)).float(), torch.full((2, 1, 1, 4), 65504.0))


@pytest.mark.parametrize("interleaved", [None, Splats(torch.rand(11, 3))])
def test_what_has_no_room_is_not_kept(interleaved):
    one = kept(interleaved=interleaved)
    assert one.nbytes == 2 * 5 * 7 * 4 * 2 + (0 if interleaved is None else 11 * 3 * 4)
    store = LayerStore(CPU, 2 * one.nbytes + 1, ram_bytes=1 << 30)
    for view in range(3):
        store.put(view, one)
    assert store.nbytes == 2 * one.nbytes
    assert [store.get(view) is None for view in range(4)] == [False, False, True, True]
    assert torch.equal(store.get(1).layers, one.layers)
    store.put(3, kept(0, 0))  # a smaller one has room yet
    assert store.get(3) is not None


def test_pinned_memory_counts_in_powers_of_two_as_it_is_given():
    one = kept(interleaved=Splats(torch.rand(11, 3)))  # 560 and 132 bytes
    for ram_bytes, fit in ((1024 + 256 - 1, 0), (1024 + 256, 1), (2 * (1024 + 256), 2)):
        store = LayerStore(torch.device("cuda"), 0, ram_bytes)
        for view in range(3):
            store.put(view, one)
        assert store.nbytes == fit * one.nbytes


def test_layers_that_are_not_finite_are_an_error_that_says_so(make, photos, monkeypatch):
    def spoilt(parts):
        layers = packed(parts)
        layers[1, 2, 3, 0] = float("inf")
        return layers

    monkeypatch.setattr(visit, "packed", spoilt)
    with pytest.raises(RuntimeError, match=r"layers around block \d have NaN .* diverged"):
        train(make(blocks=2, steps=10), photos)
