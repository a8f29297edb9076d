"""Gaussians as several cameras see them, in gsplat's shapes, and these cameras on the device."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from gsplat.cuda._wrapper import spherical_harmonics
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.render.cuda.kinds import Kind, OnScreen
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.types import Crop, Gaussians, View

MOST_KEPT = 1 << 14
"""Small tensors that are kept on the device; then all are forgotten."""


class Kept:
    """Small tensors on the device that steps would otherwise upload again and again."""

    def __init__(self) -> None:
        self._held: dict[Hashable, Tensor] = {}

    def get(self, keys: Sequence[Hashable], make: Callable[[list[int]], Sequence[Tensor]]) -> list[Tensor]:
        """A tensor for each key; `make` is asked once for all places whose key is new."""
        new = [k for k, key in enumerate(keys) if key not in self._held]
        if new:
            if len(self._held) + len(new) > MOST_KEPT:
                self._held.clear()
                new = list(range(len(keys)))
            with torch.inference_mode(False), torch.no_grad():  # they outlive this call
                self._held.update(zip((keys[k] for k in new), make(new), strict=True))
        return [self._held[key] for key in keys]


class Cameras:
    """Matrices of views, which are on the CPU, and corners of crops, on the device."""

    def __init__(self) -> None:
        self._views: dict[tuple[int, int], View] = {}
        self._poses, self._corners = Kept(), Kept()

    def poses(
        self, views: Sequence[View], like: Tensor
    ) -> tuple[Float[Tensor, "c 4 4"], Float[Tensor, "c 3 3"], Float[Tensor, "c 3"]]:
        """World to camera, intrinsics, and centres in world space; all new ones in one copy. Those that take
        gradients are not kept."""
        place = like.device, like.dtype
        if len(self._views) > MOST_KEPT:
            self._views, self._poses = {}, Kept()
        if any(view.viewmat.requires_grad for view in views):
            packed = _rows(views).to(like)
        else:
            keys = [(id(view.viewmat), id(view.K), *place) for view in views]
            packed = torch.stack(self._poses.get(keys, partial(self._new_poses, views, like)))
        return packed[:, :16].view(-1, 4, 4), packed[:, 16:25].view(-1, 3, 3), packed[:, 25:]

    def corners(self, crops: Sequence[Crop], like: Tensor) -> Float[Tensor, "c 2"]:
        """(x, y) of upper left corners; written there by the device, so nothing is copied."""
        keys = [(crop.x, crop.y, like.device, like.dtype) for crop in crops]
        return torch.stack(self._corners.get(keys, partial(_new_corners, crops, like)))

    def _new_poses(self, views: Sequence[View], like: Tensor, new: list[int]) -> Sequence[Tensor]:
        for k in new:  # holds on to tensors by whose identity views are known
            self._views[id(views[k].viewmat), id(views[k].K)] = views[k]
        return _rows([views[k] for k in new]).to(like, non_blocking=True).unbind()


def _new_corners(crops: Sequence[Crop], like: Tensor, new: list[int]) -> Sequence[Tensor]:
    place = {"dtype": like.dtype, "device": like.device}
    pairs = ((crops[k].x, crops[k].y) for k in new)
    return [torch.stack([torch.full((), x, **place) for x in pair]) for pair in pairs]


def _rows(views: Sequence[View]) -> Float[Tensor, "c 28"]:
    """Both matrices of each view, and its centre."""
    return torch.stack([torch.cat((v.viewmat.flatten(), v.K.flatten(), v.center)) for v in views])


@dataclass(frozen=True)
class Projected:
    """n Gaussians in each of c cameras of one image size and near plane; pixels of the full images."""

    radii: Int[Tensor, "c n"]
    """0 where nothing is drawn; nothing else is initialised there."""
    means2d: Float[Tensor, "c n 2"]
    depths: Float[Tensor, "c n"]
    shapes: Float[Tensor, "c n s"]
    """See Splats."""
    opacities: Float[Tensor, "c n"]
    features: Float[Tensor, "c n 4"]
    """Colour, then depth: what is composited."""
    centers: Float[Tensor, "c n 2"]
    """Where their middles are; by whose gradient they grow."""

    @staticmethod
    def nothing(cameras: int, rows: int, like: Tensor) -> "Projected":
        """No Gaussian, of which Splats would have so many rows."""
        centers, features, shapes = (like.new_zeros((cameras, 0, k)) for k in (2, 4, rows - 11))
        depths = features[..., 3]
        return Projected(depths.int(), centers, depths, shapes, depths, features, centers)

    def splats(self, camera: int, which: Int[Tensor, "k"] | None = None) -> Splats:
        """As one of the cameras sees them, or these of them."""
        values = (self.means2d, self.depths, self.shapes, self.opacities, self.features[..., :3], self.radii)
        of_one = (
            value[camera] if which is None else value[camera].index_select(0, which) for value in values
        )
        each = (value if value.dim() == 2 else value[:, None] for value in of_one)
        *rows, radii = (value.to(self.depths).T for value in each)
        bounds = radii.new_zeros((3, radii.shape[1]))  # as the CPU has them
        return Splats(torch.cat((*rows, bounds, radii)))


def place_on_screen(
    kind: Kind, gaussians: Gaussians, views: Sequence[View], cameras: Cameras, antialiased: bool = False
) -> tuple[OnScreen, Float[Tensor, "c 3"]]:
    """Where views see Gaussians, and the views' centres in world space."""
    *matrices, centers = cameras.poses(views, gaussians.means)
    return kind.place(gaussians, tuple(matrices), views[0], antialiased), centers


def project(
    kind: Kind,
    gaussians: Gaussians,
    views: Sequence[View],
    cameras: Cameras,
    sh_degree: int,
    antialiased: bool,
) -> Projected:
    """The first half of gsplat's `rasterization(packed=False)`, for the full images.

    Args:
        views: of one size and near plane.
    """
    placed, eyes = place_on_screen(kind, gaussians, views, cameras, antialiased)
    radii, means2d, depths, shapes, centers, compensations = placed
    opacities = gaussians.opacities.flatten().sigmoid().expand(len(views), -1)
    if compensations is not None:
        opacities = opacities * compensations
    # All, whatever the degree: gsplat's kernels read those of it alone.
    coefficients = torch.cat((gaussians.features_dc[:, None], gaussians.features_rest), dim=1)
    # Camera by camera: for all at once gsplat would copy the coefficients, most of a Gaussian, for each.
    directions = (gaussians.means - eyes[:, None]).unbind()
    seen = zip(directions, (radii > 0).unbind(), strict=True)
    colors = torch.stack([spherical_harmonics(sh_degree, d, coefficients, masks=m) for d, m in seen])
    features = torch.cat((torch.clamp_min(colors + 0.5, 0.0), depths[..., None]), dim=-1)
    return Projected(radii, means2d, depths, shapes, opacities, features, centers)
