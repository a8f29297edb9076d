"""2DGS's fragments: where a pixel's ray meets the disc, and gsplat's low-pass filter around its middle."""

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render import surfel_kernels as rows
from abcd_ns.engine.render.cpu.torch_kernels import Params, alpha_of, offsets

OFF_X, OFF_Y, A, B, C, D, W, W_X, W_Y, OPACITY = range(3, 13)
"""Rows after the middle on screen and the depth: from there to the box's middle; the matrix's first two rows,
with pixels counted from the middle; the determinant that (s, t) is divided by, at the middle and as it
changes with x and y."""


class _Known(NamedTuple):
    dx: Tensor
    dy: Tensor
    box_x: Tensor
    box_y: Tensor
    s: Tensor
    t: Tensor
    inverse: Tensor
    """1 / w."""
    on_disc: Tensor
    """Where the disc is what counts, not the filter."""


class SurfelFragments:
    """sigma = min((s^2 + t^2) / 2, ex^2 + ey^2), with e = the box's middle - pixel.

    With d = mean - pixel and w = W - dx Wx - dy Wy, s = (B dy - D dx) / w and t = (C dx - A dy) / w. With g =
    dL/dsigma, p = g s / w, q = g t / w, r = -(p s + q t), all 0 where the filter counts, the sums are g; p, q
    and r, by themselves, times dx and times dy; 2 g ex and 2 g ey where the filter counts; colours and depth.
    """

    opacity = OPACITY
    gradients = 16

    def alphas(self, side: int, params: Params, origins: Float[Tensor, "2 a"]) -> tuple[Tensor, _Known]:
        """See Fragments. As in gsplat, rays within the disc's plane meet nothing."""
        dx, dy = offsets(params, origins, side)
        off_x, off_y, a, b, c, d, w, w_x, w_y = params[OFF_X:OPACITY][:, :, None].unbind(0)
        determinant = w - dx * w_x - dy * w_y
        meets = determinant != 0
        inverse = 1.0 / torch.where(meets, determinant, 1.0)
        s, t = (b * dy - d * dx) * inverse, (c * dx - a * dy) * inverse
        box_x, box_y = dx + off_x, dy + off_y
        on_disc, filtered = 0.5 * (s * s + t * t), box_x * box_x + box_y * box_y
        is_disc = on_disc <= filtered
        sigma = torch.where(is_disc, on_disc, filtered)
        known = _Known(dx, dy, box_x, box_y, s, t, inverse, is_disc)
        return alpha_of(params[OPACITY], sigma, meets), known

    def sums(
        self, _: Params, known: _Known, weights: Tensor, sigma_grads: Tensor, upstream: Tensor
    ) -> list[Tensor]:
        """See Fragments."""
        dx, dy, box_x, box_y, s, t, inverse, on_disc = known
        # What is divided by next to nothing may be infinite, where the filter counts.
        p = torch.where(on_disc, sigma_grads * s * inverse, 0.0)
        q = torch.where(on_disc, sigma_grads * t * inverse, 0.0)
        r = torch.where(on_disc, -(p * s + q * t), 0.0)
        filtered = torch.where(on_disc, 0.0, 2.0 * sigma_grads)
        planes = [sigma_grads, *(x for each in (p, q, r) for x in (each, each * dx, each * dy))]
        planes += [filtered * box_x, filtered * box_y]
        return planes + [weights * upstream[channel] for channel in range(4)]

    def table(self, drawn: Float[Tensor, "d m"]) -> Float[Tensor, "c m"]:
        """See Fragments."""
        return torch.stack(_table(*drawn.unbind(0)))

    def to_drawn(self, drawn: Float[Tensor, "d m"], sums: Float[Tensor, "m g"]) -> Float[Tensor, "d m"]:
        """See Fragments."""
        table, pull = torch.func.vjp(_table, *drawn.unbind(0))
        a, b, c, d, _, w_x, w_y, opacity = table[A : OPACITY + 1]
        g, p, p_dx, p_dy, q, q_dx, q_dy, r, r_dx, r_dy, e_x, e_y, *colors, depth = sums.T[: self.gradients]
        middle = (c * q - d * p - w_x * r + e_x, b * p - a * q - w_y * r + e_y)
        matrix = (-q_dy, p_dy, q_dx, -p_dx)
        found = (*middle, depth, e_x, e_y, *matrix, r, -r_dx, -r_dy, -g / opacity, *colors)
        return torch.stack(pull(found))


def _table(*drawn: Tensor) -> tuple[Any, ...]:
    a, b, c, d, e, f = rows.relative_matrix(drawn)
    u, v = drawn[rows.U], drawn[rows.V]
    determinant = (a * d - b * c, f * c - e * d, e * b - f * a)
    box = (drawn[rows.X] - u, drawn[rows.Y] - v)
    return (u, v, drawn[rows.DEPTH], *box, a, b, c, d, *determinant, *drawn[rows.OPACITY :])
