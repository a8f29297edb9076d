"""The values that the engine passes around: Gaussians, views, crops and layers."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Integer
from torch import Tensor

PARAM_NAMES = ("means", "scales", "quats", "features_dc", "features_rest", "opacities")
"""A Gaussian's parameters, under the names of nerfstudio's parameter groups, optimizers and checkpoints."""

NEAR_PLANE = 0.01
"""gsplat's near plane; world units."""
CHUNK = 1 << 18
"""Points of a scene's that are looked at at once: what is computed of each takes many times its own bytes."""


def as_indices(rows: Tensor | slice) -> Tensor | slice:
    """`rows` to take out of many tensors: of a mask the indices, for whose number a device is waited once."""
    is_mask = isinstance(rows, Tensor) and rows.dtype == torch.bool
    return rows.nonzero()[:, 0] if is_mask else rows


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians as they are optimised: before activation, in world space."""

    means: Float[Tensor, "n 3"]
    """Centres, world units."""
    scales: Float[Tensor, "n 3"]
    """Natural logarithm of the standard deviations, world units."""
    quats: Float[Tensor, "n 4"]
    """Rotations as (w, x, y, z); need not be normalised."""
    features_dc: Float[Tensor, "n 3"]
    """Spherical harmonics of degree 0."""
    features_rest: Float[Tensor, "n k 3"]
    """Spherical harmonics of degrees 1 and up; k = (degree + 1)^2 - 1."""
    opacities: Float[Tensor, "n 1"]
    """Logit of the opacity."""

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def nbytes(self) -> int:
        """Bytes of all parameters."""
        return sum(value.nbytes for _, value in self.items())

    @property
    def sh_degree(self) -> int:
        """The highest degree of spherical harmonics that is stored."""
        return int((self.features_rest.shape[1] + 1) ** 0.5) - 1

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) pairs in the order of PARAM_NAMES."""
        return ((name, getattr(self, name)) for name in PARAM_NAMES)

    def __getitem__(self, rows: Integer[Tensor, "m"] | Tensor | slice) -> "Gaussians":
        """The Gaussians at `rows` (indices, a boolean mask or a slice)."""
        rows = as_indices(rows)
        return Gaussians(**{name: value[rows] for name, value in self.items()})

    def to(self, *args, **kwargs) -> "Gaussians":
        """As Tensor.to, for every parameter."""
        return Gaussians(**{name: value.to(*args, **kwargs) for name, value in self.items()})

    def detach(self) -> "Gaussians":
        """Cut from any autograd graph; shares memory."""
        return Gaussians(**{name: value.detach() for name, value in self.items()})

    def of_degree(self, sh_degree: int) -> "Gaussians":
        """With spherical harmonics up to this degree: those above go, those that are missing are 0."""
        more = (sh_degree + 1) ** 2 - 1 - self.features_rest.shape[1]
        return self if more == 0 else replace(self, features_rest=F.pad(self.features_rest, (0, 0, 0, more)))

    @staticmethod
    def cat(parts: Sequence["Gaussians"]) -> "Gaussians":
        """All parts in one list, in order, with as many harmonics as any has. `parts` must not be empty."""
        highest = max(part.sh_degree for part in parts)
        parts = [part.of_degree(highest) for part in parts]
        return Gaussians(**{name: torch.cat([getattr(p, name) for p in parts]) for name in PARAM_NAMES})

    @staticmethod
    def empty(sh_degree: int = 3, device: torch.device | str = "cpu", dtype=torch.float32) -> "Gaussians":
        """No Gaussians, with room for the given degree of spherical harmonics."""
        shapes = ((3,), (3,), (4,), (3,), ((sh_degree + 1) ** 2 - 1, 3), (1,))
        return Gaussians(*(torch.zeros((0, *shape), device=device, dtype=dtype) for shape in shapes))


assert tuple(f.name for f in fields(Gaussians)) == PARAM_NAMES


class Crop(NamedTuple):
    """A rectangle of pixels: columns x .. x + width - 1 and rows y .. y + height - 1 of a full image."""

    x: int
    y: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """(rows, columns), to index an [H, W, ...] image."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def enlarged(self, by: int) -> "Crop":
        """The same part of an image that is `by` times as wide and as high."""
        return Crop(self.x * by, self.y * by, self.width * by, self.height * by)

    def joined(self, other: "Crop") -> "Crop":
        """The least crop that holds both."""
        x, y = min(self.x, other.x), min(self.y, other.y)
        right = max(self.x + self.width, other.x + other.width)
        bottom = max(self.y + self.height, other.y + other.height)
        return Crop(x, y, right - x, bottom - y)

    def shared(self, other: "Crop") -> "Crop | None":
        """The pixels of both; None where there are none."""
        x, y = max(self.x, other.x), max(self.y, other.y)
        right = min(self.x + self.width, other.x + other.width)
        bottom = min(self.y + self.height, other.y + other.height)
        return Crop(x, y, right - x, bottom - y) if x < right and y < bottom else None

    def within(self, outer: "Crop") -> "Crop":
        """The same pixels, counted from the upper left corner of `outer`."""
        return Crop(self.x - outer.x, self.y - outer.y, self.width, self.height)


@dataclass(frozen=True)
class View:
    """A pinhole camera, in OpenCV convention (x right, y down, z forward); pixel centres at +0.5."""

    viewmat: Float[Tensor, "4 4"]
    """World to camera; float32 or float64."""
    K: Float[Tensor, "3 3"]
    """Intrinsics in pixels."""
    width: int
    height: int
    index: int = 0
    """Which camera of the training set this is; names its layers and its photo."""
    near: float = NEAR_PLANE
    """Gaussians whose mean has a smaller camera z are not drawn; world units."""
    reduction: int = 1
    """A pixel is a square of so many pixels of the photo, wide and high."""
    reach: float = 1.0
    """What the rate of means is in, world units: the extent of the cameras, but no more than a few times the
    median camera z of the points that the view sees. One camera far away at most doubles it."""
    nearest: float = 0.0
    """Least camera z of the points that it sees, but for wrong matches; 0 where none is known."""

    @property
    def full(self) -> Crop:
        """The crop that is the whole image."""
        return Crop(0, 0, self.width, self.height)

    @property
    def center(self) -> Float[Tensor, "3"]:
        """The camera's centre in world space: -R^T t."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @cached_property
    def numbers(self) -> Float[Tensor, "22"]:
        """Rows of its rotation, translation, focal lengths, middle, width, height, centre, near plane."""
        pose = (self.viewmat[:3, :3].reshape(-1), self.viewmat[:3, 3])
        pinhole = (self.K[0, 0, None], self.K[1, 1, None], self.K[:2, 2])
        size, near = ([self.width, self.height], [self.near])
        rest = (self.viewmat.new_tensor(size), self.center, self.viewmat.new_tensor(near))
        return torch.cat((*pose, *pinhole, *rest))

    def depths_of(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Bool[Tensor, "n"]]:
        """Camera z of points, world units, and which of them are in the image, beyond the near plane."""
        matrix, K = self.viewmat.to(points), self.K.to(points)
        x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).unbind(1)
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        return z, (z > self.near) & (u >= 0) & (u < self.width) & (v >= 0) & (v < self.height)

    def reduced(self, by: int) -> "View":
        """The same camera with pixels `by` times as wide; a last column or row that is not whole goes."""
        if by == 1:
            return self
        smaller = self.resized(1 / by, self.width // by, self.height // by)
        return replace(smaller, reduction=self.reduction * by)

    def resized(self, times: float, width: int, height: int) -> "View":
        """The same camera with an image of this size, in which everything is so many times as large."""
        scale = self.K.new_tensor([[times], [times], [1.0]])
        return replace(self, K=self.K * scale, width=width, height=height)

    def to(self, *args, **kwargs) -> "View":
        """As Tensor.to, for both matrices."""
        return replace(self, viewmat=self.viewmat.to(*args, **kwargs), K=self.K.to(*args, **kwargs))


def centers_of(views: Iterable[View]) -> Float[Tensor, "v 3"]:
    """Of cameras in world space, float64 on the CPU; see View.center."""
    poses = torch.stack([view.viewmat.detach() for view in views]).double().cpu()
    return -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0]


@dataclass(frozen=True)
class Layer:
    """What some Gaussians look like alone from one camera: no background, premultiplied."""

    color: Float[Tensor, "h w 3"]
    """Premultiplied linear colour; may exceed 1."""
    transmittance: Float[Tensor, "h w"]
    """The share of light from behind that passes: 1 - alpha."""
