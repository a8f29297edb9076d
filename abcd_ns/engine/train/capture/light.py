"""The light each photo was taken in: a colour transform of its composited picture, found while training."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import Packed
from abcd_ns.engine.transfer import finest, upload
from abcd_ns.errors import UserError

Kind = Literal["none", "exposure", "affine"]
RATE, DECAY_USES = 0.05, 10.0
"""Adam's at a view's first use, and the uses after which it is halved: it falls as in an average."""
LAST_RATE = 0.03
"""Share of it that is left at the end of the run."""
BETAS = (0.9, 0.999)
AMONG_OTHERS = 0.5
"""Share of the rate where a visit shows only a part of each picture."""
TABLE_ROWS = 1820
"""Of one table on disk, which is a quarter of a MiB then, moments included."""


class Light:
    """A transform for each view, [3, 4], by which colour c becomes M c + o. All begin as the identity, which
    is always their mean: otherwise the scene's colours would drift.

    Args:
        kind: `exposure` leaves a gain for each channel, `affine` everything free.
        device: where pictures are.
    """

    def __init__(self, kind: Kind, views: Sequence[int], device: torch.device | str = "cpu") -> None:
        self.kind, self._device = kind, torch.device(device)
        self._rows = {view: row for row, view in enumerate(sorted(views))}
        self._identity = torch.eye(3, 4, device=self._device)
        self._free = self._identity if kind == "exposure" else torch.ones_like(self._identity)
        # Less the identity and the mean, which is `_sum` / views: a step touches its own views only.
        self._changes = torch.zeros(len(self._rows), 3, 4, device=self._device)
        self._sum = torch.zeros(3, 4, dtype=finest(self._device), device=self._device)
        self._first, self._second = (torch.zeros_like(self._changes) for _ in BETAS)
        self._uses = torch.zeros(len(self._rows), device=self._device)
        self._stepped: set[int] = set()

    @torch.no_grad()
    def of(self, view: int) -> Float[Tensor, "3 4"]:
        """The transform of a view: a leaf, by whose gradient `step` goes."""
        common = (self._sum / len(self._rows)).float()
        return (self._identity + (self._changes[self._rows[view]] - common)).requires_grad_()

    @torch.no_grad()
    def step(self, gradients: Sequence[tuple[int, Tensor]], damping: float = 1.0) -> None:
        """Take a step of Adam (Kingma and Ba 2015) with damped rates, by pairs of a view and the gradient by
        its transform, one for each picture. What is no number counts as zero."""
        if not gradients:
            return
        of_views: dict[int, Tensor] = {}
        for view, gradient in gradients:
            row = self._rows[view]
            of_views[row] = of_views[row] + gradient if row in of_views else gradient
        rows = sorted(of_views)
        self._stepped.update(rows)
        places = upload(torch.tensor(rows), self._device)
        summed = (torch.stack([of_views[row] for row in rows]) * self._free).nan_to_num(0.0, 0.0, 0.0)
        self._uses[places] += 1
        uses = self._uses[places].view(-1, 1, 1)
        first = self._first[places] = self._first[places].lerp(summed, 1 - BETAS[0])
        second = self._second[places] = self._second[places].lerp(summed.square(), 1 - BETAS[1])
        first, second = (m / (1 - beta**uses) for m, beta in zip((first, second), BETAS, strict=True))
        before = self._changes[places]
        after = before - damping * RATE / (1 + uses / DECAY_USES) * first / (second.sqrt() + 1e-15)
        self._changes[places] = after
        self._sum += (after.to(self._sum) - before.to(self._sum)).sum(dim=0)

    def changed(self) -> dict[str, Packed]:
        """All that has changed since the last call, by the names to keep it under; shares no memory."""
        parts, tables = {row // TABLE_ROWS for row in self._stepped}, {}
        self._stepped.clear()
        for part in sorted(parts | {0}) if parts else ():
            tensors = {name: value.to("cpu", copy=True) for name, value in self._tensors(part).items()}
            tables[f"light-{part}"] = Packed(tensors, {"kind": self.kind})
        return tables

    def restore(self, table: Callable[[str], Packed | None]) -> None:
        """Read back what `changed` gave, by name; a UserError if these are transforms of another kind."""
        for part in range(-(-len(self._rows) // TABLE_ROWS)):
            kept = table(f"light-{part}")
            if kept is None:
                continue
            if kept.meta["kind"] != self.kind:
                begun = f"--pipeline.training.light {kept.meta['kind']}"
                raise UserError(f"The run was begun with {begun}, not {self.kind}: give that.")
            for name, value in self._tensors(part).items():
                value.copy_(kept.tensors[name])

    def _tensors(self, part: int) -> dict[str, Tensor]:
        """What is kept together, itself. The first has the sum, too."""
        rows = slice(part * TABLE_ROWS, (part + 1) * TABLE_ROWS)
        found = {name: getattr(self, f"_{name}")[rows] for name in ("changes", "first", "second", "uses")}
        return found | ({"sum": self._sum} if part == 0 else {})


class HeldLight:
    """Transforms by view that somebody else found, and which stay as they are."""

    def __init__(self, transforms: Mapping[int, Tensor], device: torch.device) -> None:
        self._transforms = {view: transform.to(device) for view, transform in transforms.items()}

    def of(self, view: int) -> Float[Tensor, "3 4"]:
        return self._transforms[view]


def lit(picture: Float[Tensor, "h w 3"], transform: Float[Tensor, "3 4"]) -> Float[Tensor, "h w 3"]:
    """A composited picture in a photo's light, M c + o in each pixel, not clamped."""
    matrix = transform.to(picture.dtype)
    return picture @ matrix[:, :3].T + matrix[:, 3]
