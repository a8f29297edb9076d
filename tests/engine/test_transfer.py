"""Between host and device; the rest is seen on the simulated device."""

import torch

from abcd_ns.engine.transfer import upload


class OnDevice(torch.Tensor):
    """Says that it is on CUDA, and can be pinned as little as what is there."""

    @property
    def device(self) -> torch.device:
        return torch.device("cuda")

    def pin_memory(self) -> torch.Tensor:
        raise RuntimeError("cannot pin 'torch.cuda.FloatTensor' only dense CPU tensors can be pinned")

    def to(self, *_: object, **__: object) -> torch.Tensor:
        return self


def test_what_is_on_the_device_is_not_pinned():
    there = torch.zeros(3).as_subclass(OnDevice)
    assert upload(there, torch.device("cuda")) is there
