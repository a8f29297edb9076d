"""The simulated accelerator itself: what it refuses, and that it counts right."""

import gc

import pytest
import torch

from tests.reference.simulated_device import DEVICE, OnDevice, kernel


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


def test_cpu_scalars_are_operands_of_pointwise_operations(counts):
    x = torch.ones(3, device=DEVICE) * torch.tensor(2.0)
    x.masked_fill_(x > 3, torch.tensor(5.0))
    assert isinstance(x, OnDevice)
    assert x.tolist() == [2, 2, 2]
    assert counts.waits == {"copy to host": 1}


def test_launches_are_counted_and_views_are_none(counts):
    x = torch.zeros(4, 3, device=DEVICE)
    y = x.T[1:].unsqueeze(0).expand(2, -1, -1).detach()
    torch.empty(5, device=DEVICE)
    assert counts.launches == 1
    y = y.exp()
    y += 1
    assert counts.launches == 3
    assert counts.waited == 0


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
    assert earlier.plus(later).waits == counts.waits


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


def test_gradients_stay_on_the_device(counts):
    class Square(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            ctx.save_for_backward(x)
            return x * x

        @staticmethod
        def backward(ctx, grad):
            (x,) = ctx.saved_tensors
            return grad * 2 * x + x.new_zeros(3) + x.new_tensor([0.0, 0.0, 0.0])

    x = torch.nn.Parameter(torch.tensor([1.0, 2.0, 3.0], device=DEVICE))
    (Square.apply(x)[None, 1:].sum() * torch.tensor(2.0)).backward()
    assert x.grad.device == DEVICE
    assert x.grad.tolist() == [0, 8, 12]
    assert counts.copies_to_device == 2  # the parameter, and new_tensor


def test_fused_adam_steps_unless_its_step_is_on_the_cpu(counts):
    def adam(step_on: torch.device | str) -> torch.Tensor:
        x = torch.nn.Parameter(torch.ones(3, device=DEVICE))
        optimizer = torch.optim.Adam([x], lr=0.1, fused=True)
        moments = {name: torch.zeros(3, device=DEVICE) for name in ("exp_avg", "exp_avg_sq")}
        optimizer.state[x] = {"step": torch.tensor(0.0, device=step_on), **moments}
        x.grad = torch.ones(3, device=DEVICE)
        optimizer.step()
        return x.detach().cpu()

    assert torch.allclose(adam(DEVICE), torch.full((3,), 0.9))
    assert counts.waited == 2  # `step` is made, and the result read
    with pytest.raises(RuntimeError, match="_fused_adam_"):
        adam("cpu")


@pytest.mark.usefixtures("counts")
def test_modules_move_and_tensors_are_saved_as_those_of_the_cpu(tmp_path):
    module = torch.nn.Linear(3, 2).to(DEVICE)
    assert {p.device for p in module.parameters()} == {DEVICE}
    assert module(torch.ones(1, 3, device=DEVICE)).device == DEVICE
    torch.save(module.state_dict(), tmp_path / "x.pt")
    loaded = torch.load(tmp_path / "x.pt", weights_only=True)
    assert {value.device.type for value in loaded.values()} == {"cpu"}
    assert torch.equal(loaded["weight"], module.to("cpu").weight)


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


def test_a_kernel_is_one_launch_with_its_waits(counts):
    def _scaled(x, y):
        return x * y + 1, x.sum()

    x = torch.ones(3, device=DEVICE)
    launches = counts.launches
    product, total = kernel(_scaled, x, x, waits=2)
    assert counts.launches == launches + 1
    assert counts.waits == {"scaled": 2}
    assert product.device == total.device == DEVICE
    with pytest.raises(RuntimeError, match="address"):
        kernel(_scaled, x, torch.ones(3))
    assert kernel(_scaled, torch.ones(3), torch.ones(3), waits=2)[1] == 3
    assert counts.waits == {"scaled": 2}
