"""Between host and device; the rest is seen on the simulated device."""

from types import SimpleNamespace

import torch

from abcd_ns.engine.transfer import StepNumbers, finest, upload


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


def test_apples_device_has_no_float64():
    found = [finest(torch.device(name)) for name in ("cpu", "cuda", "mps")]
    assert found == [torch.float64, torch.float64, torch.float32]


def test_a_device_whose_stream_has_no_name_is_copied_from_too(monkeypatch):
    event = SimpleNamespace(record=lambda: None, synchronize=lambda: None)  # as torch.mps has it
    monkeypatch.setattr("abcd_ns.engine.transfer.event_of", lambda _: lambda: event)
    monkeypatch.setattr(torch, "get_device_module", lambda _: SimpleNamespace(Event=lambda: event))
    numbers = StepNumbers(torch.device("cpu"))
    numbers.send({"errors": list(torch.arange(3.0))})
    assert list(numbers.read()) == [{"errors": [0.0, 1.0, 2.0]}]
