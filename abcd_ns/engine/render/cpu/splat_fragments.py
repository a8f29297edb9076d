"""3DGS's fragments: a Gaussian on screen."""

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.cpu.torch_kernels import Params, alpha_of, offsets
from abcd_ns.engine.render.splat_kernels import CONIC_XX, CONIC_XY, CONIC_YY, OPACITY


class SplatFragments:
    """sigma = (xx dx^2 + yy dy^2) / 2 + xy dx dy, with d = mean - pixel.

    With s = dL/dsigma the sums are the moments s, s dx, s dy, s dx^2, s dx dy, s dy^2; then those of colours
    and depth; then |dL/d(x, y)|.
    """

    opacity = OPACITY
    gradients = 10

    def alphas(
        self, side: int, params: Params, origins: Float[Tensor, "2 a"]
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """See Fragments."""
        dx, dy = offsets(params, origins, side)
        half_xx, xy, half_yy = 0.5 * params[CONIC_XX], params[CONIC_XY], 0.5 * params[CONIC_YY]
        sigma = dx * (half_xx[:, None] * dx + xy[:, None] * dy) + half_yy[:, None] * dy * dy
        return alpha_of(params[OPACITY], sigma, sigma >= 0), (dx, dy)

    def sums(
        self,
        params: Params,
        known: tuple[Tensor, Tensor],
        weights: Tensor,
        sigma_grads: Tensor,
        upstream: Tensor,
    ) -> list[Tensor]:
        """See Fragments."""
        dx, dy = known
        s_dx, s_dy = sigma_grads * dx, sigma_grads * dy
        planes = [sigma_grads, s_dx, s_dy, s_dx * dx, s_dx * dy, s_dy * dy]
        planes += [weights * upstream[channel] for channel in range(4)]
        xx, xy, yy = params[CONIC_XX][:, None], params[CONIC_XY][:, None], params[CONIC_YY][:, None]
        return [*planes, (xx * s_dx + xy * s_dy).abs(), (xy * s_dx + yy * s_dy).abs()]

    def table(self, drawn: Float[Tensor, "d m"]) -> Float[Tensor, "c m"]:
        """See Fragments."""
        return drawn

    def to_drawn(self, drawn: Float[Tensor, "d m"], sums: Float[Tensor, "m g"]) -> Float[Tensor, "d m"]:
        """See Fragments."""
        xx, xy, yy, opacity = drawn[CONIC_XX : OPACITY + 1]
        s, s_dx, s_dy, s_xx, s_xy, s_yy, *colors, depth = sums.T[: self.gradients]
        means = (xx * s_dx + xy * s_dy, xy * s_dx + yy * s_dy)
        conics = (0.5 * s_xx, s_xy, 0.5 * s_yy)
        return torch.stack((*means, depth, *conics, -s / opacity, *colors))
