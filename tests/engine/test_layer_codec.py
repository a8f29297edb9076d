"""A layer survives its codec, and no altered layer is ever believed."""

import hashlib
import struct

import numpy as np
import pytest
import torch
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from abcd_ns.engine.storage import layer_codec
from abcd_ns.engine.storage.layer_codec import LayerDecodeError, decode, encode, through_codec
from abcd_ns.engine.types import Layer

HEADER = struct.Struct("<4sBBxxIIQ")


@st.composite
def layers(draw):
    height, width = draw(st.integers(0, 6)), draw(st.integers(0, 6))
    color = draw(hnp.arrays(np.float32, (height, width, 3), elements=st.floats(-1e5, 1e5, width=32)))
    transmittance = draw(hnp.arrays(np.float32, (height, width), elements=st.floats(0, 1, width=32)))
    return Layer(torch.from_numpy(color), torch.from_numpy(transmittance))


def small_layer() -> Layer:
    generator = torch.Generator().manual_seed(3)
    return Layer(3 * torch.rand(5, 4, 3, generator=generator), torch.rand(5, 4, generator=generator))


def forge(height: int, width: int, payload: bytes, bits: int = 16, version: int = 1) -> bytes:
    """A layer whose checksum is right, whatever its header claims."""
    header = HEADER.pack(b"ABCL", version, bits, height, width, len(payload))
    return header + hashlib.blake2b(header + payload, digest_size=16).digest() + payload


@given(layers())
def test_32_bits_are_exact(layer):
    back = decode(encode(layer, 32))
    assert back.color.dtype == back.transmittance.dtype == torch.float32
    assert torch.equal(back.color, layer.color)
    assert torch.equal(back.transmittance, layer.transmittance)


@given(layers())
def test_16_bits_are_close(layer):
    back = decode(encode(layer, 16))
    assert back.color.shape == layer.color.shape
    assert ((back.transmittance - layer.transmittance).abs() <= 1e-5).all()
    expected = layer.color.clamp(-65504, 65504)
    assert ((back.color - expected).abs() <= 2**-11 * expected.abs() + 2**-25).all()


@given(layers(), st.sampled_from([16, 32]))
def test_a_second_trip_changes_nothing(layer, bits):
    once = encode(decode(encode(layer, bits)), bits)
    assert encode(decode(once), bits) == once


@given(layers(), st.sampled_from([16, 32]))
def test_rounding_is_what_packing_and_unpacking_does(layer, bits):
    rounded, back = through_codec(layer, bits), decode(encode(layer, bits))
    assert torch.equal(rounded.color, back.color)
    assert torch.equal(rounded.transmittance, back.transmittance)
    assert rounded.color.dtype == rounded.transmittance.dtype == torch.float32


@pytest.mark.parametrize("pack", [encode, through_codec])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_pixels_that_are_no_numbers_are_refused(pack, value):
    layer = small_layer()
    layer.color[1, 2, 0] = value
    with pytest.raises(ValueError, match="diverged"):
        pack(layer, 16)


def test_16_bits_keep_the_ends_of_transmittance_and_bright_colours():
    color = torch.tensor([1.5, 0.0, 1e9]).repeat(1, 4, 1)
    back = decode(encode(Layer(color, torch.tensor([[0.0, 1.0, 1 + 1e-6, -1e-6]])), 16))
    assert back.transmittance.tolist() == [[0.0, 1.0, 1.0, 0.0]]
    assert back.color[0, 0].tolist() == [1.5, 0.0, 65504.0]


def test_strides_dtype_and_autograd_do_not_matter():
    layer = small_layer()
    turned = Layer(
        layer.color.double().permute(2, 1, 0).contiguous().permute(2, 1, 0).requires_grad_(),
        layer.transmittance.double().T.contiguous().T,
    )
    assert encode(turned, 32) == encode(layer, 32)


def test_decoded_tensors_own_their_memory():
    data = encode(small_layer(), 32)
    first = decode(data)
    first.color.zero_()
    first.transmittance.zero_()
    assert torch.equal(decode(data).color, small_layer().color)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("where", ["color", "transmittance"])
def test_a_diverged_layer_is_refused(bad, where):
    layer = small_layer()
    getattr(layer, where)[2, 1] = bad
    with pytest.raises(ValueError, match="NaN or infinite"):
        encode(layer, 16)


@pytest.mark.parametrize("bits", [16, 32])
def test_every_truncation_is_found(bits):
    data = encode(small_layer(), bits)
    for length in range(len(data)):
        with pytest.raises(LayerDecodeError):
            decode(data[:length])
    with pytest.raises(LayerDecodeError):
        decode(data + b"\0")


@pytest.mark.parametrize("bits", [16, 32])
def test_every_flipped_bit_is_found(bits):
    data = encode(small_layer(), bits)
    for offset in range(len(data)):
        for bit in range(8):
            flipped = bytearray(data)
            flipped[offset] ^= 1 << bit
            with pytest.raises(LayerDecodeError):
                decode(bytes(flipped))


@pytest.mark.parametrize(
    ("height", "width", "raw_bytes"),
    [
        (2**16, 2**16, 8),  # more pixels than any layer
        (2**32 - 1, 2**32 - 1, 0),  # overflows 64 bits when multiplied by the size of a pixel
        (1000, 1000, 8),  # fewer bytes than pixels
        (1, 1, 2**26),  # a bomb: more bytes than pixels
    ],
)
def test_absurd_sizes_are_refused_before_anything_is_unpacked(monkeypatch, height, width, raw_bytes):
    payload = zstandard.ZstdCompressor().compress(bytes(raw_bytes))

    def never(*_):
        raise AssertionError("unpacked")

    monkeypatch.setattr(layer_codec.zstandard, "ZstdDecompressor", never)
    with pytest.raises(LayerDecodeError):
        decode(forge(height, width, payload))


def test_a_frame_that_hides_its_size_or_is_none_is_refused():
    compressor = zstandard.ZstdCompressor(write_content_size=False)
    for payload in (compressor.compress(bytes(8)), b"no frame at all", b""):
        with pytest.raises(LayerDecodeError):
            decode(forge(1, 1, payload))


def test_a_frame_that_lies_about_its_size_is_refused():
    frame = bytearray(zstandard.ZstdCompressor().compress(bytes(range(8))))
    assert frame[5] == 8  # the size follows the magic number and the descriptor
    frame[5] = 16
    with pytest.raises(LayerDecodeError):
        decode(forge(1, 2, bytes(frame)))


def test_another_format_names_both():
    with pytest.raises(LayerDecodeError, match=r"format 9.*format 1"):
        decode(forge(1, 1, b"", version=9))


def test_bits_must_be_16_or_32():
    with pytest.raises(LayerDecodeError):
        decode(forge(1, 1, zstandard.compress(bytes(4)), bits=8))
