"""Photos by index, read on demand and kept in memory under a byte budget."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import psutil
import torch
from cachetools import LRUCache
from jaxtyping import Bool, Num, UInt8
from PIL import Image
from torch import Tensor

from abcd_ns.data.input_errors import InputError
from abcd_ns.data.picture_files import has_alpha, open_picture, undecodable
from abcd_ns.data.undistort import Undistortion

READERS = 4  # threads that decode what is expected
FEWEST_AHEAD = 12  # photos that are read ahead beyond the budget: those of a step and of the next
_MASK_USED = 255
_LOSSY = ("JPEG", "MPO", "WEBP")


@dataclass(frozen=True)
class PhotoSource:
    """How one file becomes the photo of its camera: decode, reduce, undistort."""

    path: Path
    stored: tuple[int, int]  # (width, height) that the file must have; EXIF orientation is not applied
    reduced: tuple[int, int]  # (width, height) after area averaging; `stored` where nothing is to be reduced
    undistortion: Undistortion | None = None
    """From the reduced photo to the final one; None leaves the pixels as they are."""
    mask_path: Path | None = None
    """A picture of the stored size or in the same proportion; see `visible` for which pixels are used."""
    alpha_color: tuple[float, float, float] | None = None
    """What lies behind transparent pixels, 0 to 1; None keeps the alpha channel."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the final photo."""
        return self.undistortion.pinhole.size if self.undistortion else self.reduced


_Read = Callable[[PhotoSource], Tensor]  # of a photo or mask
_Key = tuple[_Read, int]  # and the source's index


def default_budget() -> int:
    """Bytes: 2 GiB, or 10% of the machine's memory where that is less."""
    return min(2 << 30, psutil.virtual_memory().total // 10)


class Photos:
    """The photos of a set of cameras, by one source each, which alone decides their pixels. Safe to use from
    several threads. Between calls, `budget_bytes` of decoded pixels may stay in memory: with None
    `default_budget()`, and with 0 every call reads the file."""

    def __init__(self, sources: Sequence[PhotoSource], budget_bytes: int | None = None):
        self.sources = tuple(sources)
        self.budget_bytes = default_budget() if budget_bytes is None else budget_bytes
        largest = max((3 * source.size[0] * source.size[1] for source in self.sources), default=1)
        self._ahead = max(FEWEST_AHEAD, self.budget_bytes // (8 * largest))
        self._readers = ThreadPoolExecutor(READERS, "photos")
        self._lock = threading.Lock()
        self._kept: LRUCache[_Key, Tensor] = LRUCache(self.budget_bytes, getsizeof=lambda kept: kept.nbytes)
        self._expected: OrderedDict[_Key, Future[Tensor]] = OrderedDict()

    @property
    def cached_bytes(self) -> int:
        """Of decoded pixels that are kept now."""
        return self._kept.currsize

    def image(self, index: int) -> UInt8[Tensor, "h w c"]:
        """A whole photo, c = 3 or (with alpha) 4. Shared with later callers: do not write to it."""
        return self._get(_read_photo, index)

    def expect(self, indices: Iterable[int]) -> None:
        """Begin to decode the first of these photos and their masks, if they are not kept, for the next
        requests: as many as take an eighth of the budget, and a few in any case."""
        for index in islice(indices, self._ahead):
            self._expect(_read_photo, index)
            if self.sources[index].mask_path:
                self._expect(_read_mask, index)

    def mask(self, index: int) -> Bool[Tensor, "h w 1"] | None:
        """Which pixels count, or None where the photo has no mask. Do not write to it. A reduced or
        undistorted pixel counts only if all pixels that it is made of count."""
        return self._get(_read_mask, index) if self.sources[index].mask_path else None

    def _expect(self, read: _Read, index: int) -> None:
        """Read it on another thread, for the next `_get`."""
        key = read, index
        with self._lock:
            if key in self._kept:
                return
            if key not in self._expected:
                self._expected[key] = self._readers.submit(read, self.sources[index])
            self._expected.move_to_end(key)
            while len(self._expected) > 2 * self._ahead:  # with a mask each; else its visit is over
                self._expected.popitem(last=False)[1].cancel()

    def _get(self, read: _Read, index: int) -> Tensor:
        key = read, index
        with self._lock:
            if key in self._kept:
                return self._kept[key]
            expected = self._expected.pop(key, None)
        # Not under the lock, so that two threads may both read one.
        value = read(self.sources[index]) if expected is None else expected.result()
        with self._lock:
            if value.nbytes <= self.budget_bytes:
                self._kept[key] = value
        return value


def area_reduce(image: Num[np.ndarray, "h w c"], size: tuple[int, int]) -> Num[np.ndarray, "y x c"]:
    """The mean of the area that each pixel covers; `size` is (width, height), at most the source's."""
    if size == image.shape[1::-1]:
        return image
    reduced = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return reduced.reshape(size[1], size[0], image.shape[2])


def weighted_by_alpha(
    image: UInt8[np.ndarray, "h w c"], change: Callable[[np.ndarray], np.ndarray]
) -> UInt8[np.ndarray, "y x c"]:
    """A photo resampled by `change`, of uint8 or float32. With alpha, colours are resampled times alpha, so
    that what lies below transparent pixels does not show."""
    if image.shape[2] < 4 or (image[..., 3] == 255).all():
        return change(image)
    alpha = image[..., 3:].astype(np.float32) / 255
    changed = change(np.concatenate([image[..., :3] * alpha, image[..., 3:]], axis=2, dtype=np.float32))
    changed[..., :3] *= 255 / np.maximum(changed[..., 3:], 1e-3)
    return np.rint(changed).clip(0, 255).astype(np.uint8)


def visible(picture: Image.Image) -> Bool[np.ndarray, "h w"]:
    """Which pixels of a mask are used: neither black nor transparent.

    Edges of grey masks with values of 128 or more are soft: below three quarters of the largest they are
    black. Lossy files are cut at half of it. In others any value but 0 may be a label, also that of a palette
    without colours.
    """
    alpha = np.array(picture.convert("RGBA"))[..., 3] if has_alpha(picture) else np.uint8(255)
    if picture.mode.startswith(("I", "F")):
        colors = np.array(picture)[..., None]
    else:
        colors = np.atleast_3d(picture.convert("L" if picture.mode in ("1", "L", "LA") else "RGB"))
        if picture.mode == "P" and not colors.any():
            colors = np.array(picture)[..., None]
    value = colors.max(axis=2)
    grey = (colors == colors[..., :1]).all()
    cut = 0.5 if picture.format in _LOSSY else 0.75 if grey and value.max() >= 128 else 0
    return (value > cut * value.max()) & (alpha >= 128)


def reduces_to(stored: tuple[int, int], size: tuple[int, int]) -> bool:
    """Whether a picture is large enough for a size, and in its proportion to half a pixel of the result."""
    (wide, high), (width, height) = stored, size
    return wide >= width and high >= height and abs(wide / high * height - width) <= max(1, width / height)


def _decode(path: Path, pixels: Callable[[Image.Image], np.ndarray]) -> np.ndarray:
    try:
        with open_picture(path) as picture:
            return pixels(picture)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise undecodable(path, error) from None


def _read_photo(source: PhotoSource) -> Tensor:
    image = _decode(source.path, lambda p: np.array(p.convert("RGBA" if has_alpha(p) else "RGB")))
    width, height = source.stored
    if image.shape[:2] != (height, width):
        raise InputError(f"{source.path} is no longer {width} x {height} px; put the photo back.")
    if source.alpha_color is not None and image.shape[2] == 4:
        alpha, behind = image[..., 3:].astype(np.float32) / 255, 255 * np.float32(source.alpha_color)
        image = np.rint(image[..., :3] * alpha + behind * (1 - alpha)).astype(np.uint8)
    flat = source.undistortion
    if flat or source.reduced != source.stored:
        reduced = partial(area_reduce, size=source.reduced)
        image = weighted_by_alpha(image, lambda px: flat.apply(reduced(px)) if flat else reduced(px))
    return torch.from_numpy(image)


def _read_mask(source: PhotoSource) -> Tensor:
    mask = _decode(source.mask_path, visible)[..., None]
    size, (width, height) = mask.shape[1::-1], source.stored
    if not reduces_to(size, source.reduced):  # masks_N and full-size masks both do
        shapes = f"{size[0]} x {size[1]} px, unlike its photo ({width} x {height})"
        raise InputError(f"{source.mask_path}: {shapes}; replace it.")
    used = area_reduce(mask * np.uint8(_MASK_USED), source.reduced)
    if source.undistortion:
        used = source.undistortion.apply(np.where(used == _MASK_USED, used, 0))
    if not (used == _MASK_USED).any():
        raise InputError(f"{source.mask_path} hides the whole photo; remove the frame or repair the mask.")
    return torch.from_numpy(used == _MASK_USED)
