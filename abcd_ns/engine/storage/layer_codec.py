"""Layers as bytes: a checked header, then colour and transmittance in 16 or 32 bits, compressed."""

import hashlib
import struct
from typing import Literal

import numpy as np
import torch
import zstandard
from torch import Tensor

from abcd_ns.engine.types import Layer

FORMAT_VERSION = 1
MAX_PIXELS = 2**27
"""Larger layers are refused before anything is allocated; the largest photos have about 10^8 pixels."""

_MAGIC = b"ABCL"
_HEADER = struct.Struct("<4sBBxxIIQ")  # magic, format version, bits, height, width, bytes of payload
_CHECKSUM_BYTES = 16
_DTYPES = {16: (np.dtype("<f2"), np.dtype("<u2")), 32: (np.dtype("<f4"), np.dtype("<f4"))}
_FULL = 65535  # the uint16 that stands for a transmittance of 1


class LayerDecodeError(ValueError):
    """These bytes are no layer, or no longer the layer that they were."""


def encode(layer: Layer, bits: Literal[16, 32]) -> bytes:
    """Pack a layer.

    bits = 32 keeps float32 exactly. bits = 16 keeps colour as float16, clamped to +-65504, and transmittance
    as round(65535 T), clamped to [0, 1]: 0 and 1 are exact, the error is at most 0.5 / 65535 < 1e-5.

    Raises:
        ValueError: NaN or infinity in the layer, more than MAX_PIXELS pixels, or bits neither 16 nor 32.
    """
    if bits not in _DTYPES:
        raise ValueError(f"A layer is stored in 16 or 32 bits, not {bits}.")
    height, width = layer.transmittance.shape
    if height * width > MAX_PIXELS:
        raise ValueError(f"A layer of {width} x {height} pixels exceeds the limit of {MAX_PIXELS} pixels.")
    color, transmittance = _rounded(layer, bits)
    color_dtype, transmittance_dtype = _DTYPES[bits]
    raw = _split_bytes(color, color_dtype) + _split_bytes(transmittance, transmittance_dtype)
    payload = zstandard.ZstdCompressor(level=1).compress(raw)
    header = _HEADER.pack(_MAGIC, FORMAT_VERSION, bits, height, width, len(payload))
    return header + _checksum(header, payload) + payload


def _rounded(layer: Layer, bits: Literal[16, 32]) -> tuple[Tensor, Tensor]:
    """Colour and transmittance on the CPU as they are stored; with 16 bits transmittance counts 1 / _FULL."""
    color = layer.color.detach().to("cpu", torch.float32)
    transmittance = layer.transmittance.detach().to("cpu", torch.float32)
    if not (np.isfinite(color.numpy()).all() and np.isfinite(transmittance.numpy()).all()):
        raise ValueError("A layer with NaN or infinite pixels is not stored; its block has diverged.")
    if bits == 32:
        return color, transmittance
    # torch converts to float16 a hundred times faster than numpy
    largest = torch.finfo(torch.float16).max
    return color.clamp(-largest, largest).to(torch.float16), (transmittance.clamp(0, 1) * _FULL).round()


def decode(data: bytes | memoryview) -> Layer:
    """Unpack what `encode` packed: float32 tensors on the CPU that own their memory.

    Raises:
        LayerDecodeError: truncated, altered or foreign bytes, another format version, or an absurd shape.
            All of this is found before memory for the pixels is allocated.
    """
    height, width, bits, payload = _checked_parts(memoryview(data))
    color_dtype, transmittance_dtype = _DTYPES[bits]
    color_bytes = height * width * 3 * color_dtype.itemsize
    raw_bytes = color_bytes + height * width * transmittance_dtype.itemsize
    try:
        # A frame states its size; one that states another size than the header's could be a bomb.
        if zstandard.frame_content_size(payload) != raw_bytes:
            raise LayerDecodeError("The layer's shape and its compressed size do not agree.")
        raw = np.frombuffer(zstandard.ZstdDecompressor().decompress(payload), np.uint8)
    except zstandard.ZstdError as error:
        raise LayerDecodeError(f"The layer's pixels cannot be decompressed: {error}.") from error
    color = _join_bytes(raw[:color_bytes], color_dtype).to(torch.float32)
    transmittance = _join_bytes(raw[color_bytes:], transmittance_dtype).to(torch.float32)
    if bits == 16:
        transmittance /= _FULL
    return Layer(color.reshape(height, width, 3), transmittance.reshape(height, width))


def _checked_parts(data: memoryview) -> tuple[int, int, int, memoryview]:
    """(height, width, bits, payload) of an encoded layer whose header, length and checksum are right."""
    start = _HEADER.size + _CHECKSUM_BYTES
    if len(data) < start:
        raise LayerDecodeError(f"A layer has at least {start} bytes; these are {len(data)}.")
    magic, version, bits, height, width, size = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise LayerDecodeError("These bytes do not begin as a layer does.")
    if version != FORMAT_VERSION:
        raise LayerDecodeError(f"The layer has format {version}; this program reads format {FORMAT_VERSION}.")
    if bits not in _DTYPES or height * width > MAX_PIXELS:
        raise LayerDecodeError(f"The header claims {width} x {height} pixels of {bits} bits.")
    payload = data[start:]
    if len(payload) != size:
        raise LayerDecodeError(f"The layer should have {size} compressed bytes but has {len(payload)}.")
    if _checksum(data[: _HEADER.size], payload) != data[_HEADER.size : start]:
        raise LayerDecodeError("The layer's checksum is wrong: its bytes have changed.")
    return height, width, bits, payload


def _checksum(header: bytes | memoryview, payload: bytes | memoryview) -> bytes:
    digest = hashlib.blake2b(header, digest_size=_CHECKSUM_BYTES)
    digest.update(payload)
    return digest.digest()


def _split_bytes(values: Tensor, dtype: np.dtype) -> bytes:
    """`values` as `dtype`: all first bytes, then all second bytes, and so on.

    Exponents then lie beside exponents, which zstd packs a third smaller.
    """
    array = np.ascontiguousarray(values.numpy()).astype(dtype, copy=False)
    return array.reshape(-1, 1).view(np.uint8).T.tobytes()


def _join_bytes(raw: np.ndarray, dtype: np.dtype) -> Tensor:
    """The inverse of `_split_bytes`: a flat tensor that owns its memory."""
    joined = np.empty((raw.size // dtype.itemsize, dtype.itemsize), np.uint8)
    for i, plane in enumerate(raw.reshape(dtype.itemsize, -1)):
        joined[:, i] = plane  # far faster than copying the transpose
    values = joined.view(dtype).reshape(-1)
    # Old releases of torch have no uint16.
    return torch.from_numpy(values.astype(np.int32) if dtype.kind == "u" else values)


def through_codec(layer: Layer, bits: Literal[16, 32]) -> Layer:
    """What `layer` would be after it was packed and unpacked: float32, on the CPU.

    Raises:
        ValueError: NaN or infinity in the layer.
    """
    color, transmittance = _rounded(layer, bits)
    return Layer(color.to(torch.float32), transmittance / _FULL if bits == 16 else transmittance)
