"""The size of a batch's images, as gsplat's strategies read it to bring gradients to one scale."""

from collections.abc import Sequence

import torch
from torch import Tensor

from abcd_ns.engine.types import View


def image_size(views: Sequence[View], device: torch.device | str) -> dict[str, int | Tensor]:
    """`width` and `height` of an `info`: of all views, or, where they differ, of each, [v, 1].

    gsplat multiplies gradients [v, n] by them.
    """
    sizes = [(view.width, view.height) for view in views]
    if len(set(sizes)) == 1:
        return dict(zip(("width", "height"), sizes[0], strict=True))
    width, height = torch.tensor(sizes, device=device).T[..., None]
    return {"width": width, "height": height}
