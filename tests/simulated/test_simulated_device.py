"""The simulated accelerator itself: what it refuses, and that it counts right."""

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
