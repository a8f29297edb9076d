"""A model's outputs under the names that nerfstudio's tools read."""

from collections import UserDict
from collections.abc import Callable, Iterable, KeysView, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render import Raster
from abcd_ns.engine.types import Layer


class Outputs(UserDict[str, Tensor]):
    """Outputs by name: some are drawn, and `later` draws the others when they are first read."""

    def __init__(self, drawn: Mapping[str, Tensor], later: Mapping[str, Callable[[], Tensor]]) -> None:
        # nerfstudio's viewer opens with the first name, and splits its picture with the last one.
        first = dict(list(drawn.items())[:1])
        super().__init__({**first, **dict.fromkeys(later), **drawn})
        self._later = dict(later)

    def draw(self, names: Iterable[str]) -> None:
        """Draw those of these names that are not drawn yet."""
        for name in names:
            if name in self._later:
                self[name] = self._later.pop(name)()

    def keys(self) -> KeysView[str]:
        """The names: ns-render prints them, and `UserDict.keys` would print all values."""
        return self.data.keys()

    def __getitem__(self, name: str) -> Tensor:
        self.draw([name])
        return super().__getitem__(name)


def pictured(layer: Layer, raster: Raster, background: Float[Tensor, "3"]) -> dict[str, Tensor]:
    """A picture with the colours of `layer` and the depth of `raster`, under splatfacto's names."""
    transmittance = layer.transmittance[..., None]
    alpha = 1 - raster.transmittance[..., None]
    # Where nothing is, splatfacto shows the farthest depth of the picture.
    depth = torch.where(alpha > 0, raster.depth[..., None] / alpha.clamp_min(1e-10), raster.depth.max())
    return {
        "rgb": (layer.color + transmittance * background).clamp(0, 1),
        "depth": depth,
        "accumulation": 1 - transmittance,
        "background": background.expand(*layer.color.shape),
    }


def as_list(values: Tensor | list[Tensor]) -> list[Tensor]:
    """Of one picture or of a batch's."""
    return values if isinstance(values, list) else [values]


def masked(pictures: list[Tensor], masks: list[Tensor | None]) -> list[Tensor]:
    """Black where a picture has a mask that is false."""
    pairs = zip(pictures, masks, strict=True)
    return [picture if mask is None else picture * mask.to(picture.device) for picture, mask in pairs]
