"""The light each photo was taken in: a colour transform of its finished picture, found while training.

F, the live block, B and the background are composited first. So no layer hangs on a transform, and all stay
valid whatever becomes of it. Transforms belong to the run and not to a block: of each photo there is one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.packed import Packed
from abcd_ns.engine.train.capture import bilateral_grid
from abcd_ns.engine.transfer import Download, finest, upload
from abcd_ns.engine.types import Crop, View
from abcd_ns.errors import UserError

Kind = Literal["none", "exposure", "affine", "bilateral"]
Gradients = Sequence[tuple[int, Tensor]]
"""(view, the gradient by its transform) pairs, one for each picture."""
RATE, SETTLES = 0.05, 10.0
"""Adam's at a view's first use, and the uses after which it is halved: it falls as in an average."""
GRID_RATE = 0.005
"""Of a grid, at first: it has cells enough to take over what is the scene's."""
LAST_RATE = 0.03
"""Share of it that is left at the end of the run."""
BETAS = (0.9, 0.999)
AMONG_OTHERS = 0.5
"""Share of the rate where a visit shows only a part of each picture."""
TABLE_BYTES = 1 << 18
"""Of what is written together, about, with moments: a grid alone, as a visit has few views; small transforms
by the thousand."""


@dataclass(frozen=True)
class Use:
    """A picture that was drawn in its photo's light."""

    view: int
    transform: Float[Tensor, "3 4"] | Float[Tensor, "12 l r c"]
    """A leaf, if it learns."""
    weight: float = 1.0
    """Of the loss of the whole picture in that of the step."""


class Light:
    """A transform for each view, [3, 4], by which colour c becomes M c + o, or a grid of these. All begin as
    the identity, which their mean over the views always is: otherwise the scene's colours would drift, and
    the transforms with them.

    Grids take 0.3 MiB a view, with moments, and stay in RAM, from where those of a step's views are copied.

    Args:
        kind: `exposure` leaves a gain for each channel, `affine` everything free, `bilateral` everything in
            each place of a grid.
        views: their indices.
        device: where pictures are.
    """

    def __init__(self, kind: Kind, views: Sequence[int], device: torch.device | str = "cpu") -> None:
        self.kind, self._rate = kind, GRID_RATE if kind == "bilateral" else RATE
        self._rows = {view: row for row, view in enumerate(sorted(views))}
        self._device = torch.device(device)
        is_grid = kind == "bilateral"
        self._home = torch.device("cpu") if is_grid else self._device
        shape = (12, *bilateral_grid.SHAPE) if is_grid else (3, 4)
        identity = torch.eye(3, 4, device=self._home)
        self._free = identity if kind == "exposure" else torch.ones(shape, device=self._home)
        self._identity = identity.view(12, 1, 1, 1).expand(shape) if is_grid else identity
        # Less the identity and what they have in common, which is `_sum` by the number of views: no step
        # needs to touch more than its own.
        self._changes = torch.zeros((len(self._rows), *shape), dtype=torch.float32, device=self._home)
        self._sum = torch.zeros(shape, dtype=finest(self._home), device=self._home)
        self._first, self._second = (torch.zeros_like(self._changes) for _ in BETAS)
        self._uses = torch.zeros(len(self._rows), device=self._home)
        self._stepped: set[int] = set()
        self._pending: tuple[list[int], Download, float] | None = None

    @torch.no_grad()
    def of(self, view: int) -> Float[Tensor, "3 4"] | Float[Tensor, "12 l r c"]:
        """The transform of a view: a leaf, by whose gradient `step` goes."""
        self._settle()
        common = (self._sum / len(self._rows)).float()
        now = self._identity + (self._changes[self._rows[view]] - common)
        return upload(now, self._device).requires_grad_()

    @torch.no_grad()
    def step(self, gradients: Gradients, damping: float = 1.0) -> None:
        """Take a step of Adam (Kingma and Ba 2015, algorithm 1), for each view that the step shows its own:
        the others keep their transforms and moments.

        Args:
            gradients: of all pictures of the step; those that are no numbers count as zero.
            damping: share of the rates.
        """
        if not gradients:
            return
        self._settle()
        of_views: dict[int, Tensor] = {}
        for view, gradient in gradients:
            row = self._rows[view]
            of_views[row] = of_views[row] + gradient if row in of_views else gradient
        rows = sorted(of_views)
        summed = torch.stack([of_views[row].to(self._device) for row in rows])
        self._stepped.update(rows)
        if self._home == self._device:
            self._adapt(rows, summed, damping)
        else:  # the device is still at it: whoever asks for a transform next sees to it
            self._pending = rows, Download(summed), damping

    def _settle(self) -> None:
        """Take the step that waits for its gradients."""
        if self._pending is not None:
            (rows, gradients, damping), self._pending = self._pending, None
            self._adapt(rows, gradients.read(), damping)

    @torch.no_grad()
    def _adapt(self, rows: Sequence[int], gradients: Tensor, damping: float) -> None:
        places = upload(torch.tensor(rows), torch.device(self._home))
        summed = (gradients * self._free).nan_to_num(0.0, 0.0, 0.0)
        self._uses[places] += 1
        uses = self._uses[places].view(-1, *[1] * (summed.ndim - 1))
        first = self._first[places] = self._first[places].lerp(summed, 1 - BETAS[0])
        second = self._second[places] = self._second[places].lerp(summed.square(), 1 - BETAS[1])
        first, second = (m / (1 - beta**uses) for m, beta in zip((first, second), BETAS, strict=True))
        before = self._changes[places]
        after = before - damping * self._rate / (1 + uses / SETTLES) * first / (second.sqrt() + 1e-15)
        self._changes[places] = after
        self._sum += (after.to(self._sum) - before.to(self._sum)).sum(dim=0)

    # -- at rest -------------------------------------------------------------------------------------

    def changed(self) -> dict[str, Packed]:
        """All that has changed since the last call, by the names under which it is to be kept; shares no
        memory."""
        self._settle()
        parts = {row // self._together for row in self._stepped}
        self._stepped.clear()
        return {_name(part): self._table(part) for part in sorted(parts | {0})} if parts else {}

    def restore(self, table: Callable[[str], Packed | None]) -> None:
        """Stand where all that `changed` ever gave was kept.

        Args:
            table: finds it by name; None for nothing.

        Raises:
            UserError: these are transforms of another kind.
        """
        for part in range(-(-len(self._rows) // self._together)):
            kept = table(_name(part))
            if kept is None:
                continue
            if kept.meta["kind"] != self.kind:
                raise UserError(
                    f"The run was begun with --pipeline.training.light {kept.meta['kind']}: go on with that, "
                    f"not with {self.kind}."
                )
            for name, value in self._tensors(part).items():
                value.copy_(kept.tensors[name])

    @property
    def _together(self) -> int:
        """Rows of a table."""
        return max(1, TABLE_BYTES // (self._changes[:1].nbytes * 3))

    def _table(self, part: int) -> Packed:
        tensors = {name: value.to("cpu", copy=True) for name, value in self._tensors(part).items()}
        return Packed(tensors, {"kind": self.kind})

    def _tensors(self, part: int) -> dict[str, Tensor]:
        """What is kept together, itself. The first has the sum, too."""
        rows = slice(part * self._together, (part + 1) * self._together)
        found = {name: getattr(self, f"_{name}")[rows] for name in ("changes", "first", "second", "uses")}
        return found | ({"sum": self._sum} if part == 0 else {})


class HeldLight:
    """Transforms that somebody else found, and which stay as they are.

    Args:
        transforms: by view.
    """

    def __init__(self, transforms: Mapping[int, Tensor], device: torch.device) -> None:
        self._transforms = {view: transform.to(device) for view, transform in transforms.items()}

    def of(self, view: int) -> Float[Tensor, "3 4"] | Float[Tensor, "12 l r c"]:
        """The transform of a view."""
        return self._transforms[view]

    def step(self, gradients: Gradients, damping: float = 1.0) -> None:
        """Nothing."""


def gradients_of(uses: Sequence[Use]) -> Gradients:
    """What a step's backward has left in the transforms of its pictures, and by how much grids are to be
    smoother."""
    found = []
    for use in uses:
        if use.transform.grad is None:
            continue
        gradient = use.transform.grad
        if gradient.ndim > 2:
            smooth = bilateral_grid.of_total_variation(use.transform)
            gradient = gradient + bilateral_grid.TV_WEIGHT * use.weight * smooth
        found.append((use.view, gradient))
    return found


def lit(
    picture: Float[Tensor, "h w 3"],
    transform: Float[Tensor, "3 4"] | Float[Tensor, "12 l r c"],
    part: Crop,
    view: View,
) -> Float[Tensor, "h w 3"]:
    """A composited picture in a photo's light, M c + o in each pixel, not clamped.

    Args:
        picture: a part of the view's.
    """
    if transform.ndim > 2:
        of_pixels = bilateral_grid.sliced(transform, picture, part, view)
        return (of_pixels[..., :3] @ picture[..., None])[..., 0] + of_pixels[..., 3]
    matrix = transform.to(picture.dtype)
    return picture @ matrix[:, :3].T + matrix[:, 3]


def _name(part: int) -> str:
    return f"light-{part}"
