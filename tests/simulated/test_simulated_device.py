"""The simulated accelerator itself: what it refuses, and that it counts right."""

import gc

import pytest
import torch

from tests.reference.simulated_device import DEVICE


def test_tensors_on_different_devices_are_refused(counts):
    x = torch.ones(3, device=DEVICE)
    for mix in (
        lambda: x + torch.ones(3),
        lambda: torch.ones(3) * x,
        lambda: torch.cat((x, torch.ones(3))),
        lambda: torch.stack((x.sum(), torch.tensor(1.0))),
        lambda: x.index_select(0, torch.tensor([0])),
        lambda: torch.where(x > 0, x, torch.zeros(3)),
        lambda: torch.nn.functional.linear(torch.ones(2, 3), x[None]),
    ):
        with pytest.raises(RuntimeError, match="same device"):
            mix()
    with pytest.raises(TypeError, match="cpu"):
        x.numpy()
    with pytest.raises(RuntimeError, match="generator"):
        torch.rand(3, device=DEVICE, generator=torch.Generator())
    assert counts.copies_to_host == counts.copies_to_device == 0


def test_copies_and_their_bytes_are_counted(counts):
    x = torch.zeros(6).to(DEVICE)
    torch.zeros(2, dtype=torch.float64).to(DEVICE, non_blocking=True)
    x.copy_(torch.ones(6))
    earlier = counts.copy()
    assert (x.to(torch.float64).cpu() == 1).all()
    assert (counts.copies_to_device, counts.bytes_to_device) == (3, 24 + 16 + 24)
    assert (counts.copies_to_host, counts.bytes_to_host) == (1, 48)
    assert counts.waits == {"copy to device": 2, "copy to host": 1}
    assert set(counts.places) == {"elsewhere"}
    later = counts.since(earlier)
    assert (later.launches, later.copies_to_host, later.copies_to_device) == (1, 1, 0)


def test_waits_are_counted_by_operation(counts):
    x = torch.arange(4.0, device=DEVICE)
    assert float(x.sum()) == 6
    assert bool((x > 2).any())
    x.nonzero()
    x[x > 1]
    x[x > 1] = 0.0  # as masked_fill
    ids = torch.tensor([1, 2], device=DEVICE)
    ids.repeat_interleave(ids)
    ids.repeat_interleave(ids, output_size=3)
    x[ids]
    x[torch.tensor([2, 0])]  # indices on the CPU are copied
    waits = {"_local_scalar_dense": 2, "nonzero": 1, "index": 1, "copy to device": 2, "repeat_interleave": 1}
    assert counts.waits == waits
    assert counts.waited == 7


def test_memory_is_that_of_live_tensors(counts):
    gc.collect()
    before = counts.live_bytes
    counts.reset_peak()
    x = torch.zeros(1000, device=DEVICE)
    view = x[10:].view(-1, 2)
    y = (x + 1).sum()
    assert counts.live_bytes - before == 4000 + 4
    assert counts.peak_bytes - before == 8000 + 4
    del x
    assert counts.live_bytes - before == 4000 + 4
    del view, y
    assert counts.live_bytes == before
    x = torch.nn.Parameter(torch.zeros(1000, device=DEVICE))
    loss = x.exp().sum()
    assert counts.live_bytes - before == 4000 + 4000 + 4  # what autograd saves
    loss.backward()
    assert counts.live_bytes - before == 4000 + 4000 + 4  # the gradient instead
    x.grad, x.data = None, x.data.new_empty(0)
    del loss
    assert x.shape == (0,)
    assert counts.live_bytes == before
