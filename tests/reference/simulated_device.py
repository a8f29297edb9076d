"""A simulated accelerator: CPU memory behind a device of its own, for machines without a GPU.

    with simulated_device() as counts:
        x = torch.zeros(3, device=DEVICE)
        x + torch.zeros(3)  # RuntimeError, as on CUDA: the tensors are on different devices
    counts.waited, counts.copies_to_host, counts.peak_bytes, ...

Tensors on `DEVICE` cannot be mixed with CPU tensors where CUDA would refuse it, through autograd, optimizers
and custom functions alike; what costs time on any accelerator is counted: points where the host waits for
the device, and copies between the two. It says nothing about seconds. `live_bytes` are those of the tensors
alone: no allocator's rounding and reserve, and no memory that a CUDA kernel takes for itself.

Kernels that exist for CUDA only are stood in for by functions under `kernel`, see gsplat_stand_ins. Random
numbers on the device come from the CPU's generator.

Built on `torch.utils.backend_registration._setup_privateuseone_for_python_backend`, which torch 2.11 calls
experimental.
"""

import functools
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

# Autograd starts threads for all devices that there are at a process' first backward pass, and after that no
# process may be forked from it. Here, before there is a device, it starts none.
torch.zeros((), requires_grad=True).backward()
_setup_privateuseone_for_python_backend("simulated")
DEVICE = torch.device("simulated", 0)
# Asked for wherever torch.autocast is named, though it be disabled.
torch.get_device_module(DEVICE).get_amp_supported_dtype = lambda: [torch.float16, torch.bfloat16]


class Event:
    """A place in the order of what the device does. What is copied to the host without waiting is void until
    an event that was recorded after it has been waited for, or a later copy that blocks."""

    _underway: ClassVar[list[tuple[Tensor, Tensor]]] = []

    def record(self, stream: None) -> None:  # noqa: ARG002 - there is one
        self._before, Event._underway = Event._underway, []

    def synchronize(self) -> None:
        _counts.wait("event")
        _arrive(self._before)


def _arrive(copies: list[tuple[Tensor, Tensor]]) -> None:
    for there, values in copies:
        there.copy_(values)
    copies.clear()


torch.get_device_module(DEVICE).Event = Event
torch.get_device_module(DEVICE).current_stream = lambda _: None

WAITS = {
    "_linalg_check_errors",
    "_local_scalar_dense",
    "_unique2",
    "bincount",
    "equal",
    "masked_select",
    "multinomial",
    "nonzero",
    "unique_consecutive",
    "unique_dim",
}
"""Operations that the host cannot go on from before it has seen a result: a value, or how large it is."""
INDEXING = {"_index_put_impl_", "_unsafe_index", "index", "index_put", "index_put_"}
TAKES_CPU_SCALARS = {*INDEXING, "fill_", "fill", "masked_fill", "masked_fill_"}
"""Operations, beside the pointwise ones, whose operands may be 0-dimensional CPU tensors. A fused Adam is
none: its kernel reads `step` by address."""


@dataclass
class Counts:
    """What happened on the device."""

    copies_to_host: int = 0
    """Of tensors; values that are read one by one are waits alone."""
    bytes_to_host: int = 0
    copies_to_device: int = 0
    bytes_to_device: int = 0
    live_bytes: int = 0
    """Of all tensors that are there now."""
    peak_bytes: int = 0
    """The most that were there at once."""
    waits: Counter[str] = field(default_factory=Counter)
    """Points where the host waits for all that it has launched, by operation. Copies from and to pageable
    memory are among them, unless they go to the device and are called with `non_blocking`."""

    @property
    def waited(self) -> int:
        return self.waits.total()

    def copy(self) -> "Counts":
        return self.since(Counts())

    def since(self, earlier: "Counts") -> "Counts":
        """What came after `earlier`; of the bytes that are there, this moment's."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        counted = values.keys() - {"live_bytes", "peak_bytes"}
        less = {name: values[name] - getattr(earlier, name) for name in counted}
        return Counts(**{**values, **less})

    def reset_peak(self) -> None:
        self.peak_bytes = self.live_bytes

    def wait(self, why: str) -> None:
        self.waits[why] += 1

    def move(self, tensor: Tensor, *, to_device: bool, blocks: bool = True) -> None:
        way = "to_device" if to_device else "to_host"
        setattr(self, f"copies_{way}", getattr(self, f"copies_{way}") + 1)
        setattr(self, f"bytes_{way}", getattr(self, f"bytes_{way}") + tensor.numel() * tensor.element_size())
        if blocks:
            self.wait(f"copy {way}".replace("_", " "))


_counts = Counts()
_storages: dict[int, weakref.ref] = {}


def _hold(inner: Tensor) -> None:
    """Count the memory behind a tensor on the device, once for all of its views."""
    storage = inner.untyped_storage()
    key, size = storage._cdata, storage.nbytes()
    if key in _storages or size == 0:
        return

    def release(_: weakref.ref) -> None:
        del _storages[key]
        _counts.live_bytes -= size

    _storages[key] = weakref.ref(storage, release)
    _counts.live_bytes += size
    _counts.peak_bytes = max(_counts.peak_bytes, _counts.live_bytes)


class OnDevice(torch.Tensor):
    """A tensor that says it is on the device and keeps its values in a CPU tensor, `inner`."""

    @staticmethod
    def __new__(cls, inner: Tensor) -> "OnDevice":
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            layout=inner.layout,
            device=DEVICE,
        )
        made.inner = inner
        _hold(inner)
        return made

    def __init__(self, inner: Tensor) -> None: ...

    __torch_function__ = torch._C._disabled_torch_function_impl

    def __repr__(self) -> str:
        return f"{self.inner!r} on {DEVICE}"

    def __reduce_ex__(self, protocol: int) -> Any:
        return self.detach().cpu().__reduce_ex__(protocol)

    # Calls that torch's own bindings would not let reach dispatch.

    @property
    def data(self) -> Tensor:
        return torch.Tensor.data.__get__(self)

    @data.setter
    def data(self, value: Tensor) -> None:
        torch.Tensor.data.__set__(self, value)
        self.inner = _inner(value)
        _hold(self.inner)

    def tolist(self) -> Any:
        return self.detach().cpu().tolist()

    def numpy(self, *_: Any, **__: Any) -> Any:
        raise TypeError(f"can't convert {DEVICE} device type tensor to numpy; use Tensor.cpu() first")

    __array__ = numpy

    def new_tensor(self, data: Any, *, device: Any = DEVICE, dtype: Any = None, **options: Any) -> Tensor:
        return torch.tensor(data, dtype=dtype or self.dtype, **options).to(device)

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


@functools.cache
def _name_of(func: Any) -> str:
    return func._schema.name.removeprefix("aten::")


def _inner(value: Any) -> Any:
    return value.inner if isinstance(value, OnDevice) else value


def _map(function: Callable[[Any], Any], value: Any) -> Any:
    """`value` with `function` of each tensor in it; arguments of operations are no deeper than lists."""
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, (list, tuple)):
        return type(value)(_map(function, x) for x in value)
    return value


def _tensors(values: Iterable[Any]) -> list[Tensor]:
    found = []
    for value in values:
        if isinstance(value, Tensor):
            found.append(value)
        elif isinstance(value, (list, tuple)):
            found += _tensors(value)
    return found


def _is_device(device: Any) -> bool:
    return device is not None and torch.device(device).type == DEVICE.type


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """An operation as torch dispatches it, on CPU tensors, on device tensors, or between them."""
    name = _name_of(func)
    if name == "_to_copy":
        return _to_copy(func, args[0], **kwargs)
    if name == "copy_" and isinstance(args[0], OnDevice) != isinstance(args[1], OnDevice):
        to_device = isinstance(args[0], OnDevice)
        _counts.move(args[1], to_device=to_device, blocks=not (to_device and _non_blocking(args, kwargs)))
        func(_inner(args[0]), _inner(args[1]), *args[2:], **kwargs)
        return args[0]
    tensors = _tensors(args) + _tensors(kwargs.values())
    here = [x for x in tensors if isinstance(x, OnDevice)]
    if not here and not _is_device(kwargs.get("device")):
        return func(*args, **kwargs)
    _check_places(func, tensors, here)
    if (generator := kwargs.get("generator")) is not None:
        raise RuntimeError(
            f"Expected a '{DEVICE.type}' device type for generator but found '{generator.device}'"
        )
    if _waits(name, args, kwargs):
        _counts.wait(name)
    if kwargs.get("device") is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    result = func(*_map(_inner, args), **{key: _map(_inner, value) for key, value in kwargs.items()})
    return _wrapped(result, here)


def _non_blocking(args: Any, kwargs: dict[str, Any]) -> bool:
    return bool(args[2] if len(args) > 2 else kwargs.get("non_blocking", False))


def _wrapped(result: Any, given: list[OnDevice]) -> Any:
    """Results on the device; operations in place give back what they were given."""
    known = {id(x.inner): x for x in given}

    def wrap(value: Tensor) -> Tensor:
        found = known.get(id(value))
        if found is None:
            return OnDevice(value)
        if found.shape != value.shape or found.stride() != value.stride():
            raise NotImplementedError("the simulated device has no operations that change a shape in place")
        return found

    return _map(wrap, result)


def _check_places(func: Any, tensors: list[Tensor], here: list[OnDevice]) -> None:
    """Refuse what CUDA would refuse.

    Raises:
        RuntimeError: some tensors are on the CPU that must be on the device.
    """
    name = _name_of(func)
    takes_scalars = torch.Tag.pointwise in func.tags or name in TAKES_CPU_SCALARS
    for x in tensors:
        if isinstance(x, OnDevice):
            continue
        if name in INDEXING and not x.dtype.is_floating_point and here:
            _counts.move(x, to_device=True)  # indices are copied to where they are needed
        elif x.dim() > 0 or not takes_scalars:
            shapes = [(str(t.device), tuple(t.shape)) for t in tensors]
            raise RuntimeError(f"Expected all tensors to be on the same device: aten::{name} of {shapes}")


def _waits(name: str, args: Any, kwargs: dict[str, Any]) -> bool:
    if name == "repeat_interleave":
        return kwargs.get("output_size") is None
    if name in INDEXING:
        by_mask = any(x is not None and x.dtype == torch.bool for x in args[1])
        fills = name != "index" and len(args) > 2 and args[2].numel() == 1  # runs as masked_fill does
        return by_mask and not fills
    return name in WAITS


def _to_copy(
    func: Any, source: Tensor, device: Any = None, non_blocking: bool = False, **rest: Any
) -> Tensor:
    copied = func(_inner(source), **rest)
    to_device = isinstance(source, OnDevice) if device is None else _is_device(device)
    if to_device != isinstance(source, OnDevice):
        _counts.move(copied, to_device=to_device, blocks=not non_blocking)
        if non_blocking and not to_device:
            values, copied = copied, torch.full_like(copied, torch.nan if copied.is_floating_point() else -1)
            Event._underway.append((copied, values))
        elif not to_device:
            _arrive(Event._underway)  # the device works in order
    return OnDevice(copied) if to_device else copied


def kernel(compute: Callable[..., Any], *tensors: Tensor, waits: int = 0) -> Any:
    """Run `compute` on the values of `tensors` as if it were one kernel of the device.

    On CPU tensors it just runs: then nothing is counted.

    Args:
        tensors: all on the device, or none.
        waits: points in it where the host waits.
    """
    here = [x for x in tensors if isinstance(x, OnDevice)]
    if not here:
        return compute(*tensors)
    if len(here) < len(tensors):
        shapes = [(str(t.device), tuple(t.shape)) for t in tensors]
        raise RuntimeError(f"a kernel was given the address of a tensor of the host: {shapes}")
    for _ in range(waits):
        _counts.wait(compute.__name__.strip("_"))
    with _disable_current_modes():
        result = compute(*(x.inner for x in here))
    return _map(OnDevice, result)


# Below Python's dispatch (torch.tensor, another thread) torch asks the backend itself.
_library = torch.library.Library("aten", "IMPL")


def _empty(size: Any, *_: Any, dtype: torch.dtype | None = None, **__: Any) -> OnDevice:
    return OnDevice(torch.empty(size, dtype=dtype))


def _empty_strided(size: Any, stride: Any, dtype: torch.dtype | None = None, **_: Any) -> OnDevice:
    return OnDevice(torch.empty_strided(size, stride, dtype=dtype))


def _copy_from(source: Tensor, target: Tensor, non_blocking: bool = False) -> Tensor:
    if isinstance(source, OnDevice) != isinstance(target, OnDevice):
        to_device = isinstance(target, OnDevice)
        _counts.move(source, to_device=to_device, blocks=not (to_device and non_blocking))
    _inner(target).copy_(_inner(source))
    return target


_library.impl("empty.memory_format", _empty, "PrivateUse1")
_library.impl("empty_strided", _empty_strided, "PrivateUse1")
_library.impl("_copy_from", _copy_from, "PrivateUse1")


class _Dispatch(TorchDispatchMode):
    """Operations that begin without a tensor on the device."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing is compiled here, and a wrapper around each operation takes a third of all time."""
        return False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


@contextmanager
def simulated_device() -> Iterator[Counts]:
    """Tensors may be put on `DEVICE` within; gives what is counted meanwhile, and goes on being counted."""
    global _counts
    _counts = Counts(live_bytes=_counts.live_bytes, peak_bytes=_counts.live_bytes)
    with torch.autograd.set_multithreading_enabled(False), _Dispatch():
        yield _counts
