"""nerfstudio's dataset over Photos, of what our own reader or another of nerfstudio's found."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from torch import Tensor

from abcd_ns.data.input_errors import InputError, Problems
from abcd_ns.data.photos import Photos, PhotoSource, reduces_to
from abcd_ns.data.picture_files import FileFinder, check_two_files, read_size, read_whole
from abcd_ns.data.scene import Lens, distorted_lens
from abcd_ns.data.undistort import undistortion

PHOTOS = "photos"  # the entry of the metadata that holds one PhotoSource for each camera


class AbcdDataset(InputDataset):
    """The photos that a dataparser, ours or any of nerfstudio's, found: at the size of their cameras and
    without distortion. See `Photos` and `with_photos`; `scale_factor` is 1. As float32, transparent photos
    are put on the colour `behind`, if any: ns-render dataset shows four channels in false colours."""

    def __init__(
        self,
        dataparser_outputs: DataparserOutputs,
        scale_factor: float = 1.0,
        budget_bytes: int | None = None,
        needs_photos: bool = True,
        behind: Sequence[float] | None = None,
    ):
        outputs = with_photos(dataparser_outputs, needs_photos)
        super().__init__(outputs, scale_factor)
        self.photos, self._behind = Photos(outputs.metadata[PHOTOS], budget_bytes), behind

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """uint8 [H, W, 3 or 4], shared with later callers: do not write to it."""
        return self.photos.image(image_idx).numpy()

    def get_image_float32(self, image_idx: int) -> Float[Tensor, "h w c"]:
        image = super().get_image_float32(image_idx)
        if self._behind is None or image.shape[-1] == 3:
            return image
        return torch.lerp(image.new_tensor(self._behind), image[..., :3], image[..., 3:])

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """`image_idx`, `image` of the type asked for, [H, W, 3 or 4], and, if any, `mask` bool [H, W, 1]."""
        read = {"uint8": self.get_image_uint8, "float32": self.get_image_float32}[image_type]
        mask = self.photos.mask(image_idx)
        data = {"image_idx": image_idx, "image": read(image_idx)}
        return data if mask is None else data | {"mask": mask}


def has_views(outputs: DataparserOutputs) -> bool:
    """Whether there are photos with poses: of one view, instant-ngp's reader gives no place of the camera."""
    return bool(outputs.image_filenames) and outputs.cameras.camera_to_worlds.shape[-2:] == (3, 4)


def with_photos(outputs: DataparserOutputs, needs_photos: bool = True) -> DataparserOutputs:
    """The same with PHOTOS, and with the cameras of photos that are undistorted; our own reader's unchanged.
    Viewing and exporting, which look at no file, do without `needs_photos`."""
    if PHOTOS in outputs.metadata:
        return outputs
    if outputs.metadata.get("mask_color") is not None:
        raise InputError("--mask-color has no effect here: masked pixels are not trained on. Leave it out.")
    if not outputs.cameras.camera_to_worlds.isfinite().all():
        fix = "where the reader has an --orientation-method, set it to none"
        raise InputError(f"{outputs.image_filenames[0]} and others have poses with NaN or infinity; {fix}.")
    alpha_color = None if outputs.alpha_color is None else tuple(map(float, outputs.alpha_color))
    sources, lenses, problems, finders = [], [], Problems(), {}
    for row, path in enumerate(outputs.image_filenames):
        mask = outputs.mask_filenames[row] if outputs.mask_filenames else None
        with problems.collect(name=str(path)):
            lens = _lens(outputs.cameras, row, str(path))
            stored = lens.size
            if needs_photos:
                path = finders.setdefault(path.parent, FileFinder(path.parent, path)).find(path.name)
                if mask is not None and path == mask.absolute():
                    check_two_files(path, outputs.image_filenames[row].name, path.name)
                stored = read_whole(path)
                if not reduces_to(stored, lens.size):
                    shapes = f"is {stored[0]} x {stored[1]} but its camera is {lens.width} x {lens.height}"
                    raise InputError(f"{path} {shapes}; put the photos there that the model was made from.")
            flat = None
            with problems.collect(f"{path}: ", name=str(path)):  # which names no photo, as many may share it
                flat = undistortion(lens) if lens.distorted else None
            if mask is not None and needs_photos:
                read_size(mask, "mask")
            sources.append(PhotoSource(path, stored, lens.size, flat, mask, alpha_color))
            lenses.append(flat.pinhole if flat else lens)
    problems.raise_if_any()
    return dataclasses.replace(
        outputs,
        image_filenames=[source.path for source in sources],
        cameras=pinhole_cameras(lenses, outputs.cameras.camera_to_worlds),
        metadata={**outputs.metadata, PHOTOS: sources},
    )


def pinhole_cameras(lenses: Sequence[Lens], poses: Float[Tensor, "n 3 4"]) -> Cameras:
    """nerfstudio's cameras [n], perspective, without distortion, float32."""

    pinholes = torch.tensor([(lens.fx, lens.fy, lens.cx, lens.cy) for lens in lenses], dtype=torch.float32)
    sizes = torch.tensor([lens.size for lens in lenses], dtype=torch.int64)
    return Cameras(
        poses.float(),
        *pinholes.reshape(-1, 4).split(1, dim=1),
        *sizes.reshape(-1, 2).split(1, dim=1),
        camera_type=CameraType.PERSPECTIVE,
        metadata={},  # without any, `ns-export cameras` ends in an assertion
    )


def _lens(cameras: Cameras, row: int, label: str) -> Lens:
    kind = CameraType(int(cameras.camera_type[row]))
    if kind not in (CameraType.PERSPECTIVE, CameraType.FISHEYE):
        raise InputError(f"{label} is {kind.name.lower()}; photos must be perspective or fisheye ones.")
    given = cameras.distortion_params
    coefficients = [0.0] * 6 if given is None else given[row].double().tolist()
    fx, fy, cx, cy = (float(getattr(cameras, name)[row]) for name in ("fx", "fy", "cx", "cy"))
    size = int(cameras.width[row]), int(cameras.height[row])
    plain = Lens(*size, fx, fy, cx, cy, fisheye=kind is CameraType.FISHEYE)
    return distorted_lens(plain, coefficients, label)
