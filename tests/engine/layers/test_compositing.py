"""Compositing: the algebra of layers, against the formula written out pixel by pixel."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.layers.compositing import composite, empty_layer, fold, sandwich
from abcd_ns.engine.types import Layer
from tests.engine.space.test_tree import SEEDS

TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-6}
DTYPES = st.sampled_from(list(TOLERANCE))


def random_layers(seed: int, n: int, dtype: torch.dtype) -> list[Layer]:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    return [Layer(draw(3, 4, 3) / 2, draw(3, 4)) for _ in range(n)]


def assert_close(layer: Layer, expected: Layer) -> None:
    tolerance = {"rtol": 0.0, "atol": TOLERANCE[layer.color.dtype]}
    torch.testing.assert_close(layer.color, expected.color, **tolerance)
    torch.testing.assert_close(layer.transmittance, expected.transmittance, **tolerance)


def by_hand(layers: list[Layer]) -> Layer:
    """Light gathered front to back: sum of C_i times the transmittances before it, in Python floats."""
    height, width = layers[0].transmittance.shape
    folded = empty_layer(height, width, dtype=layers[0].color.dtype)
    for y in range(height):
        for x in range(width):
            color, passing = [0.0, 0.0, 0.0], 1.0
            for layer in layers:
                color = [c + passing * own for c, own in zip(color, layer.color[y, x].tolist(), strict=True)]
                passing *= float(layer.transmittance[y, x])
            folded.color[y, x] = torch.tensor(color, dtype=folded.color.dtype)
            folded.transmittance[y, x] = passing
    return folded


@given(SEEDS, st.integers(1, 7), DTYPES)
def test_fold_is_the_sum_over_layers(seed, n, dtype):
    layers = random_layers(seed, n, dtype)
    assert_close(fold(layers), by_hand(layers))


@given(SEEDS, DTYPES, st.booleans())
def test_a_sandwich_is_the_fold_on_the_background(seed, dtype, image):
    front, active, back = layers = random_layers(seed, 3, dtype)
    background = random_layers(seed + 1, 1, dtype)[0].color
    background = background if image else background[0, 0]
    expected = composite(fold(layers), background)
    torch.testing.assert_close(
        sandwich(front, active, back, background), expected, rtol=0.0, atol=TOLERANCE[dtype]
    )
