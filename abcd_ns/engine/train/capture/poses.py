"""Where each photo was taken from, refined while training: turned and moved a little from what was given.

A pose has six numbers, how the camera turns and moves in its own frame (SO3xR3, as nerfstudio's camera
optimizer has it). All poses together may not be turned, moved or scaled: held-out views would not follow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from abcd_ns.engine.render import Raster
from abcd_ns.engine.types import View

Kind = Literal["off", "SO3xR3"]
TOLERANCE = 0.05
"""Of a channel: larger errors of a pixel count less and less, as they are hardly the pose's."""
DAMPING = 3.0
"""Levenberg's and Marquardt's, of the diagonal: turning and moving to one side look nearly alike."""
LONGEST = 1.0
"""Step, in pixels that the picture moves by (root mean square)."""
LEAST_OPACITY = 0.1
"""Of a pixel that has a depth to speak of."""


class Poses:
    """A run's views, as they were given, and where they stand by now."""

    def __init__(self, views: Sequence[View]) -> None:
        self._given = {view.index: view for view in views}
        self.views = self._given
        """By index; another dictionary whenever they have moved."""

    @property
    def refined(self) -> dict[int, Float[Tensor, "4 4"]]:
        """World-to-camera matrices by view; empty where all are as they were given."""
        moved = () if self.views is self._given else self.views.items()
        return {index: view.viewmat for index, view in moved}

    def move(self, steps: Mapping[int, Float64[Tensor, "6"]]) -> None:
        """Take a step for each of these views, see `turned`; then lay all over those that were given."""
        views = sorted(self._given)
        given, now = ([some[view].viewmat.double() for view in views] for some in (self._given, self.views))
        for place, view in enumerate(views):
            if view in steps:
                now[place] = turned(now[place], steps[view])
        laid = laid_over(torch.stack(now), torch.stack(given))
        self._place(dict(zip(views, laid, strict=True)))

    def packed(self) -> dict[int, bytes]:
        """See `refined`, bit for bit."""
        return {view: pose.cpu().contiguous().numpy().tobytes() for view, pose in self.refined.items()}

    def restore(self, packed: Mapping[int, bytes]) -> None:
        """Stand where `packed` was called."""
        moved = {}
        for view, pose in packed.items():
            like = self._given[view].viewmat
            moved[view] = torch.frombuffer(bytearray(pose), dtype=like.dtype).view_as(like)
        self._place(moved)

    def _place(self, poses: Mapping[int, Float[Tensor, "4 4"]]) -> None:
        """Views stand as these matrices say, which are those of all views, or none."""
        moved = dict(self._given)
        for view, pose in poses.items():
            moved[view] = replace(moved[view], viewmat=pose.to(moved[view].viewmat))
        self.views = moved if poses else self._given


def turned(viewmat: Float64[Tensor, "4 4"], step: Float64[Tensor, "6"]) -> Float64[Tensor, "4 4"]:
    """A camera whose view turned by `step`, radians about its axes, and moved along them, world units."""
    moved = torch.eye(4, dtype=viewmat.dtype)
    moved[:3, :3], moved[:3, 3] = torch.matrix_exp(_cross(step[:3])), step[3:]
    return moved @ viewmat


def by_step(gradient: Float[Tensor, "4 4"], viewmat: Float[Tensor, "4 4"]) -> Float64[Tensor, "6"]:
    """The gradient by a step of `turned`, at 0, from that by the matrix."""
    by_motion = gradient.double() @ viewmat.double().T
    x, y, z = by_motion[:3, :3].unbind()
    return torch.stack((z[1] - y[2], x[2] - z[0], y[0] - x[1], *by_motion[:3, 3]))


def robust(residual: Float[Tensor, "h w 3"]) -> tuple[Tensor, Float[Tensor, "h w 3"]]:
    """Charbonnier's loss, summed, and the weights of pixels by which its gradient is that of squares."""
    root = (1 + (residual / TOLERANCE).square()).sqrt()
    return TOLERANCE**2 * (root - 1).sum(), 1 / root.detach()


def step_for(
    view: View, picture: Raster, weight: Float[Tensor, "h w 3"], gradient: Float64[Tensor, "6"]
) -> Float64[Tensor, "6"]:
    """A damped step of Gauss and Newton towards less of a robust loss. The gradient is exact. For the matrix,
    pixels move as their depth says and bring their colour along (Lucas and Kanade 1981)."""
    flow = _flow(view, picture)
    across, down = _slopes(picture.color)
    change = across[..., None] * flow[0][..., None, :] + down[..., None] * flow[1][..., None, :]
    change = change.reshape(-1, 6).double()
    normal = change.T @ (weight.reshape(-1, 1).double() * change)
    least = 1e-12 + 1e-9 * normal.diagonal().max()
    damped = normal + torch.diag(DAMPING * normal.diagonal() + least)
    step = -torch.linalg.solve(damped.cpu(), gradient.cpu()).nan_to_num(0.0, 0.0, 0.0)
    pixels = (flow.double() @ step.to(flow.device)).square().sum(dim=0).mean().sqrt()
    return step / max(1.0, float(pixels) / LONGEST)


def laid_over(moved: Float64[Tensor, "n 4 4"], given: Float64[Tensor, "n 4 4"]) -> Float64[Tensor, "n 4 4"]:
    """Cameras that moved a little, without what they turned, moved and grew by together (least squares)."""
    change = moved @ torch.linalg.inv(given)
    rotation = (change[:, :3, :3] - change[:, :3, :3].mT) / 2
    steps = torch.stack((rotation[:, 2, 1], rotation[:, 0, 2], rotation[:, 1, 0], *change[:, :3, 3].T), dim=1)
    together = _together(given)
    shared = together @ torch.linalg.lstsq(together, steps.reshape(-1, 1), driver="gelsd").solution
    return torch.stack([turned(a, -b) for a, b in zip(moved, shared.view(-1, 6), strict=True)])


def _together(viewmats: Float64[Tensor, "n 4 4"]) -> Float64[Tensor, "m 7"]:
    """The steps of all cameras where the world turns, moves, or grows about their mean."""
    turns = viewmats[:, :3, :3]
    centers = -(turns.mT @ viewmats[:, :3, 3:])[..., 0]
    away = centers - centers.mean(dim=0)
    rows = viewmats.new_zeros(len(viewmats), 6, 7)
    rows[:, :3, :3] = turns
    rows[:, 3:, :3] = -turns @ torch.stack([_cross(each) for each in away])
    rows[:, 3:, 3:6] = turns
    rows[:, 3:, 6:] = turns @ away[..., None]
    return rows.reshape(-1, 7)


def _cross(v: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """[v]x, so that [v]x w = v x w."""
    x, y, z = v
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero)).view(3, 3)


def _flow(view: View, picture: Raster) -> Float[Tensor, "2 h w 6"]:
    """By how much each pixel's content moves, right and down, pixels, for a unit of each number of a step."""
    depth, like = picture.depth, {"dtype": picture.depth.dtype, "device": picture.depth.device}
    opacity = 1 - picture.transmittance
    nearness = torch.where(opacity > LEAST_OPACITY, opacity / depth.clamp_min(view.near * 1e-3), 0.0)
    K = view.K.to(**like)
    x = ((torch.arange(view.width, **like) + 0.5 - K[0, 2]) / K[0, 0]).expand_as(depth)
    y = ((torch.arange(view.height, **like) + 0.5 - K[1, 2]) / K[1, 1])[:, None].expand_as(depth)
    zero = torch.zeros_like(x)
    right = torch.stack((-x * y, 1 + x * x, -y, nearness, zero, -x * nearness), dim=-1)
    below = torch.stack((-1 - y * y, x * y, x, zero, nearness, -y * nearness), dim=-1)
    return torch.stack((K[0, 0] * right, K[1, 1] * below))


def _slopes(color: Float[Tensor, "h w 3"]) -> tuple[Tensor, Tensor]:
    """Differences of neighbours, to the right and downwards; 0 at the edges."""
    across, down = torch.zeros_like(color), torch.zeros_like(color)
    across[:, 1:-1] = (color[:, 2:] - color[:, :-2]) / 2
    down[1:-1] = (color[2:] - color[:-2]) / 2
    return across, down
