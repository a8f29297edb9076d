"""The light each photo was taken in: a colour transform of its finished picture, found while training.

F, the live block, B and the background are composited first. So no layer hangs on a transform, and all stay
valid whatever becomes of it. Transforms belong to the run and not to a block: of each photo there is one.
"""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.train.capture import per_view

Kind = Literal["none", "exposure", "affine"]
Uses = Sequence[tuple[int, Tensor]]
"""(view, its transform [3, 4] or that one's gradient) pairs, one for each picture."""
RATE, SETTLES = 0.05, 10.0
"""Adam's at a view's first use, and the uses after which it is halved: it falls as in an average."""
LAST = 0.03
"""Share of it that is left at the end of the run."""
BETAS = (0.9, 0.999)
AMONG_OTHERS = 0.5
"""Share of the rate where a visit shows only a part of each picture."""


class Light:
    """A transform for each view, [3, 4]: colour c becomes M c + o. All begin as the identity, which their
    mean over the views always is: otherwise the scene's colours would drift, and the transforms with them.

    Args:
        kind: `exposure` leaves a gain for each channel, `affine` everything free.
        views: their indices.
    """

    def __init__(self, kind: Kind, views: Sequence[int], device: torch.device | str = "cpu") -> None:
        self._rows = {view: row for row, view in enumerate(sorted(views))}
        self.learns = True
        """Whether steps change it."""
        self._identity = torch.eye(3, 4, device=device)
        self._free = self._identity if kind == "exposure" else torch.ones_like(self._identity)
        # Less the identity. Helpers that are forked see in shared memory what each step makes of it.
        changes = torch.zeros((len(self._rows), 3, 4), device=device)
        self._changes = changes.share_memory_() if changes.device.type == "cpu" else changes
        self._first, self._second = torch.zeros_like(changes), torch.zeros_like(changes)
        self._uses = changes.new_zeros(len(self._rows), 1, 1)

    @torch.no_grad()
    def of(self, view: int) -> Float[Tensor, "3 4"]:
        """The transform of a view: a leaf, whose gradient `step` takes."""
        return (self._identity + self._changes[self._rows[view]]).requires_grad_(self.learns)

    @torch.no_grad()
    def step(self, gradients: Uses, damping: float = 1.0) -> None:
        """Take a step of Adam (Kingma and Ba 2015, algorithm 1), for each view that the step shows its own:
        the others keep their transforms and moments.

        Args:
            gradients: of all pictures of the step; those that are no numbers count as zero.
            damping: share of the rates.
        """
        if not self.learns or not gradients:
            return
        device = self._changes.device
        places = torch.tensor([self._rows[view] for view, _ in gradients], device=device)
        values = (torch.stack([gradient for _, gradient in gradients]) * self._free).nan_to_num(0.0, 0.0, 0.0)
        rows = torch.tensor(sorted({self._rows[view] for view, _ in gradients}), device=device)
        summed = torch.zeros_like(self._changes).index_add_(0, places, values)[rows]
        self._uses[rows] += 1
        first = self._first[rows] = self._first[rows].lerp(summed, 1 - BETAS[0])
        second = self._second[rows] = self._second[rows].lerp(summed.square(), 1 - BETAS[1])
        first, second = (
            m / (1 - beta ** self._uses[rows]) for m, beta in zip((first, second), BETAS, strict=True)
        )
        rate = damping * RATE / (1 + self._uses[rows] / SETTLES)
        self._changes[rows] -= rate * first / (second.sqrt() + 1e-15)
        self._changes -= self._changes.mean(dim=0)

    def to_json(self) -> dict[str, str]:
        """All of it at rest, bit for bit."""
        return per_view.to_json(self._tensors())

    def restore(self, data: dict[str, str]) -> None:
        """Stand where `to_json` was called."""
        per_view.restore(self._tensors(), data)

    def _tensors(self) -> dict[str, Tensor]:
        return {name: getattr(self, f"_{name}") for name in ("changes", "first", "second", "uses")}


def gradients_of(lights: Uses) -> Uses:
    """What a step's backward has left in the transforms of its pictures."""
    return [(view, transform.grad) for view, transform in lights if transform.grad is not None]


def lit(picture: Float[Tensor, "h w 3"], transform: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """A composited picture in a photo's light, M c + o in each pixel, not clamped."""
    matrix = transform.to(picture.dtype)
    return picture @ matrix[:, :3].T + matrix[:, 3]
