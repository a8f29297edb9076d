"""nerfstudio's dataset over Photos."""

from typing import Any, Literal

import numpy as np
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset

from abcd_ns.data.foreign_outputs import PHOTOS, with_photos
from abcd_ns.data.input_errors import InputError
from abcd_ns.data.photos import Photos


class AbcdDataset(InputDataset):
    """The photos that a dataparser found, at the size of their cameras and without distortion.

    Args:
        dataparser_outputs: of AbcdDataParser or any of nerfstudio's.
        scale_factor: must be 1: the dataparser's `downscale_factor` sets the size of photos.
        budget_bytes: see Photos.
        needs_photos: see `with_photos`.

    Raises:
        InputError: another scale_factor, or as `with_photos`.
    """

    def __init__(
        self,
        dataparser_outputs: DataparserOutputs,
        scale_factor: float = 1.0,
        budget_bytes: int | None = None,
        needs_photos: bool = True,
    ):
        if scale_factor != 1.0:
            raise InputError("camera_res_scale_factor has no effect: set --downscale-factor instead.")
        outputs = with_photos(dataparser_outputs, needs_photos)
        super().__init__(outputs, scale_factor)
        self.photos = Photos(outputs.metadata[PHOTOS], budget_bytes)

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """uint8 [H, W, 3 or 4], shared with later callers: do not write to it."""
        return self.photos.image(image_idx).numpy()

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """`image_idx`, `image` [H, W, 3 or 4] of the type asked for and, if any, `mask` bool [H, W, 1]."""
        read = {"uint8": self.get_image_uint8, "float32": self.get_image_float32}[image_type]
        data = {"image_idx": image_idx, "image": read(image_idx)}
        mask = self.photos.mask(image_idx)
        if mask is not None:
            data["mask"] = mask
        return data
