"""Pictures of what is drawn between layers, and their gradient, in a Triton kernel each.

    picture = clamp(C_F + T_F (C_A + T_A (C_B + T_B bg)), 0, 1)

See `layers/compositing.py` for the algebra. C_A and 1 - T_A are crops of what gsplat has drawn; layers may be
half floats.
"""

from collections.abc import Sequence

import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.base import Shown

BLOCK = 256
VALUES = (
    "front_ptr", "hides_ptr", "back_ptr", "shows_ptr", "background_ptr",
    "start", "sheet_height", "sheet_width", "top", "left", "height", "width",
    "front_row", "front_step", "hides_row", "hides_step", "back_row", "back_step", "shows_row", "shows_step",
)  # fmt: skip
"""Arguments for whose values, or alignment, no kernel is compiled anew."""


@triton.jit(do_not_specialize=VALUES)
def _between(
    features_ptr, alphas_ptr, front_ptr, hides_ptr, back_ptr, shows_ptr, background_ptr,
    picture_ptr, by_features_ptr, by_alphas_ptr, counts,
    start, sheet_height, sheet_width, top, left, height, width,
    front_row, front_step, hides_row, hides_step, back_row, back_step, shows_row, shows_step,
    LAYERS: tl.constexpr, BACKWARD: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Of one camera's part of the sheet: the picture or, from its gradient, those of features and alphas.

    A layer's pixel (row, column) is at `row` and `step` times these; `hides` and `shows` are transmittances.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    on_sheet, pixel = at < sheet_height * sheet_width, start + at
    row, column = at // sheet_width - top, at % sheet_width - left
    inside = on_sheet & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    through = 1 - tl.load(alphas_ptr + pixel, mask=inside, other=0.0)
    before, behind_all = tl.full((BLOCK,), 1.0, tl.float32), tl.full((BLOCK,), 1.0, tl.float32)
    if LAYERS:
        hides = hides_ptr + row * hides_row + column * hides_step
        shows = shows_ptr + row * shows_row + column * shows_step
        before = tl.load(hides, mask=inside, other=0.0).to(tl.float32)
        behind_all = tl.load(shows, mask=inside, other=0.0).to(tl.float32)
    by_through = tl.zeros((BLOCK,), tl.float32)
    for channel in tl.static_range(3):
        behind = behind_all * tl.load(background_ptr + channel)
        if LAYERS:
            back = back_ptr + row * back_row + column * back_step + channel
            behind += tl.load(back, mask=inside, other=0.0).to(tl.float32)
        value = tl.load(features_ptr + 4 * pixel + channel, mask=inside, other=0.0) + through * behind
        if LAYERS:
            front = front_ptr + row * front_row + column * front_step + channel
            value = tl.load(front, mask=inside, other=0.0).to(tl.float32) + before * value
        place = picture_ptr + 3 * (row * width + column) + channel
        if BACKWARD:
            shown = inside & (value >= 0) & (value <= 1)
            by_color = before * tl.load(place, mask=shown, other=0.0)
            tl.store(by_features_ptr + 4 * pixel + channel, by_color, mask=on_sheet)
            by_through += by_color * behind
        else:  # what is no number stays none
            tl.store(place, tl.where(value < 0, 0.0, tl.where(value > 1, 1.0, value)), mask=inside)
    if BACKWARD:
        weight = tl.where(inside, before * counts, 0.0)
        tl.store(by_features_ptr + 4 * pixel + 3, weight, mask=on_sheet)
        tl.store(by_alphas_ptr + pixel, -by_through, mask=on_sheet)


def between(
    features: Float[Tensor, "c h w 4"],
    alphas: Float[Tensor, "c h w 1"],
    shown: Sequence[Shown],
    gradients: Sequence[Float[Tensor, "_h _w 3"]] | None = None,
) -> list[Tensor]:
    """One picture for each camera; where gradients of these are given, those by features and alphas. The
    gradient by the depth is the weight that a pixel has by its frame."""
    _, rows, cols, _ = features.shape
    features, alphas = features.contiguous(), alphas.contiguous()
    sizes = [(down.stop - down.start, across.stop - across.start) for (down, across), _ in shown]
    if gradients is None:
        found = [features.new_empty((*size, 3)) for size in sizes]
        pictures, outputs = found, [features, alphas]  # which are not written to
    else:
        found = [features.new_empty(features.shape), alphas.new_empty(alphas.shape)]
        pictures, outputs = [gradient.contiguous() for gradient in gradients], found
    for camera, ((down, across), frame) in enumerate(shown):
        layers, strides = [features] * 4, [0] * 8
        if frame.front is not None:
            layers = [v for layer in (frame.front, frame.back) for v in (layer.color, layer.transmittance)]
            layers = [
                value if value.stride(-1) == 1 or value.ndim == 2 else value.contiguous() for value in layers
            ]
            strides = [step for value in layers for step in value.stride()[:2]]
        _between[(triton.cdiv(rows * cols, BLOCK),)](
            features, alphas, *layers, frame.background, pictures[camera], *outputs, frame.counts,
            camera * rows * cols, rows, cols, down.start, across.start, *sizes[camera], *strides,
            LAYERS=frame.front is not None, BACKWARD=gradients is not None, BLOCK=BLOCK,
        )  # fmt: skip
    return found
