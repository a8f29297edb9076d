"""Pixels: exact where nothing is to be done, an area mean where reduced, the lens's rays if undistorted."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from abcd_ns.data.input_errors import InputError
from abcd_ns.data.photos import Photos, PhotoSource, area_reduce, default_budget
from abcd_ns.data.scene import Lens
from abcd_ns.data.undistort import distort, undistortion

WIDTH, HEIGHT = 40, 24
HALF = (WIDTH // 2, HEIGHT // 2)


def noise(seed: int, channels: int = 3, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """uint8 [height, width, channels]."""
    return np.random.default_rng(seed).integers(0, 256, (size[1], size[0], channels), dtype=np.uint8)


def saved(path: Path, image: np.ndarray) -> Path:
    Image.fromarray(image.squeeze()).save(path)
    return path


@pytest.fixture
def sources(tmp_path: Path) -> list[PhotoSource]:
    size = (WIDTH, HEIGHT)
    return [PhotoSource(saved(tmp_path / f"{i}.png", noise(i)), size, size) for i in range(6)]


def naive_area_mean(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Each pixel's rectangle in the source, weighted pixel by pixel in float64."""

    def shares(old: int, new: int) -> np.ndarray:
        table = np.zeros((new, old))
        for i in range(new):
            for j in range(old):
                overlap = min((i + 1) * old / new, j + 1) - max(i * old / new, j)
                table[i, j] = max(overlap, 0) * new / old
        return table

    down, right = shares(image.shape[0], height), shares(image.shape[1], width)
    return np.einsum("yh,xw,hwc->yxc", down, right, image.astype(np.float64))


@given(
    old=st.tuples(st.integers(1, 23), st.integers(1, 23)),
    share=st.tuples(st.floats(0.05, 1), st.floats(0.05, 1)),
    channels=st.sampled_from([1, 3, 4]),
    seed=st.integers(0, 1000),
)
@settings(derandomize=True, max_examples=80, deadline=None)
def test_reducing_is_the_exact_area_mean(old, share, channels, seed):
    size = tuple(max(1, int(side * s)) for side, s in zip(old, share, strict=True))
    image = noise(seed, channels, old)
    reduced = area_reduce(image, size)
    assert reduced.shape == (size[1], size[0], channels)
    # Half a level is rounding; the rest is float32 in the sums.
    assert np.abs(reduced - naive_area_mean(image, *size)).max() <= 0.51


@pytest.mark.parametrize(
    ("picture", "mode"),
    [
        *((Image.fromarray(noise(0, channels).squeeze()), mode)
          for channels, mode in ((1, "RGB"), (2, "RGBA"), (3, "RGB"), (4, "RGBA"))),
        (Image.fromarray(noise(0)).quantize(16), "RGB"),
    ],
)  # fmt: skip
def test_a_photo_that_needs_nothing_is_bit_equal_but_for_its_mode(tmp_path, picture, mode):
    """Not turned by its EXIF orientation either: COLMAP does not."""
    exif = Image.Exif()
    exif[0x0112] = 6
    picture.save(tmp_path / "photo.png", exif=exif)
    photos = Photos([PhotoSource(tmp_path / "photo.png", picture.size, picture.size)])
    assert np.array_equal(photos.image(0).numpy(), np.array(picture.convert(mode)))


# Memory


@pytest.mark.parametrize("budget", [0, WIDTH * HEIGHT * 3, 2 * WIDTH * HEIGHT * 3 + 1, None])
def test_budget_bounds_memory_and_changes_no_pixel(sources, budget):
    photos = Photos(sources, budget)
    for i in np.random.default_rng(0).integers(0, len(sources), 40).tolist():
        assert np.array_equal(photos.image(i).numpy(), noise(i))
        assert photos.cached_bytes <= (default_budget() if budget is None else budget)
    assert (photos.cached_bytes > 0) == (budget != 0)


def test_threads_agree_on_photos(sources):
    photos, start = Photos(sources), Barrier(4)

    def work(seed: int) -> bool:
        start.wait()
        order = np.random.default_rng(seed).permutation(len(sources)).tolist() * 3
        return all(np.array_equal(photos.image(i).numpy(), noise(i)) for i in order)

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(4)))
    assert photos.cached_bytes == len(sources) * WIDTH * HEIGHT * 3


def test_expected_photo_is_read_once_and_before_it_is_asked_for(sources, monkeypatch):
    reads, opened = [], Image.open

    def counting(path: Path, *args, **kwargs):
        reads.append(int(path.stem))
        return opened(path, *args, **kwargs)

    monkeypatch.setattr(Image, "open", counting)
    photos = Photos(sources, 0)
    photos.expect([2, 1, 2])
    photos._readers.shutdown(wait=True)
    assert sorted(reads) == [1, 2]
    assert all(np.array_equal(photos.image(i).numpy(), noise(i)) for i in (1, 2))
    assert sorted(reads) == [1, 2]
    photos.image(1)  # expected once, and no budget to keep it
    assert sorted(reads) == [1, 1, 2]


@pytest.mark.parametrize("ahead", [[], [0, 1, 2]])
def test_photo_that_changed_since_the_check_is_named(sources, ahead):
    photos = Photos(sources, 0)
    sources[0].path.unlink()
    saved(sources[1].path, noise(0, size=(WIDTH + 1, HEIGHT)))
    sources[2].path.write_bytes(sources[2].path.read_bytes()[:200])
    photos.expect(ahead)
    for i in range(3):
        for _ in range(2):  # a failed read must not block the next one
            with pytest.raises(InputError, match=rf"{i}\.png"):
                photos.image(i)


# Alpha


@pytest.mark.parametrize("lens", [None, "OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("divide", [1, 2, 3])
def test_resampled_photos_show_nothing_of_what_lies_below_transparent_pixels(tmp_path, lens, divide):
    """Two thirds of the pixels are transparent, with soft edges, and magenta below."""
    size, reduced = (240, 180), (240 // divide, 180 // divide)
    flat = None if lens is None else undistortion(lens_pair(lens, *reduced)[0])
    alpha = np.random.default_rng(9).integers(-300, 320, (180, 240, 1)).clip(0, 255).astype(np.uint8)
    color = np.where(alpha == 0, [255, 0, 255], noise(0, size=size)).astype(np.uint8)
    on_black = np.rint(color * (alpha / 255.0)).astype(np.uint8)
    image = np.concatenate([color, alpha], axis=2)
    paths = saved(tmp_path / "cut.png", image), saved(tmp_path / "black.png", on_black)
    photos = Photos([PhotoSource(path, size, reduced, flat) for path in paths])
    cut, black = (photos.image(row).numpy().astype(float) for row in range(2))
    error = cut[..., :3] * cut[..., 3:] / 255 - black
    assert np.abs(error).max() < (2 if lens is None else 3)  # OpenCV rounds weights of 8-bit pixels to 1/32
    assert 0.2 < (cut[..., 3] > 0).mean() <= 1


# Masks


def read_mask(folder: Path, name: str, reduced: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """bool [height, width]."""
    photo = saved(folder / "photo.png", noise(0))
    source = PhotoSource(photo, (WIDTH, HEIGHT), reduced, mask_path=folder / name)
    return Photos([source]).mask(0).numpy()[..., 0]


def test_reduced_mask_keeps_pixels_that_count_as_a_whole(tmp_path):
    mask = np.where(np.random.default_rng(0).random((HEIGHT, WIDTH)) < 0.9, 255, 0).astype(np.uint8)
    saved(tmp_path / "mask.png", mask)
    expected = mask.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).min(axis=(1, 3)) > 0
    assert 0 < expected.mean() < 1
    reduced = read_mask(tmp_path, "mask.png", HALF)
    assert reduced.dtype == bool
    assert np.array_equal(reduced, expected)
    saved(tmp_path / "half.png", expected)  # it may have that size in its file
    assert np.array_equal(read_mask(tmp_path, "half.png", HALF), expected)


HIDDEN = np.hypot(*np.ogrid[-11:13, -20:20]) < 8
"""What a mask hides, [HEIGHT, WIDTH]."""
SEEN = np.where(HIDDEN, 0, 255).astype(np.uint8)


def palette(colors: list[int]) -> Image.Image:
    """0 where hidden."""
    picture = Image.fromarray((~HIDDEN).astype(np.uint8), "P")
    picture.putpalette(colors)
    return picture


def labelled() -> np.ndarray:
    """Objects 1 to 3, and 0 for what is hidden."""
    return np.where(HIDDEN, 0, 1 + np.arange(WIDTH) % 3).astype(np.uint8)


@pytest.mark.parametrize(
    "mask",
    [
        lambda: Image.fromarray(SEEN),
        lambda: Image.fromarray(np.dstack([SEEN] * 3)),
        lambda: Image.fromarray(SEEN).convert("1"),
        lambda: Image.fromarray(SEEN // 255),
        lambda: Image.fromarray(np.where(HIDDEN, 0, 100).astype(np.uint8)),
        lambda: Image.fromarray(labelled()),
        lambda: Image.fromarray(labelled().astype(np.uint16)),
        lambda: Image.fromarray(SEEN.astype(np.uint16) * 257),
        lambda: Image.fromarray(np.dstack([0 * SEEN, 0 * SEEN, SEEN // 4])),
        lambda: palette([0, 0, 0, 128, 0, 0]),
        lambda: palette([0, 0, 0, 0, 0, 0]),
        # Transparent is hidden, whatever the colour is.
        lambda: Image.fromarray(np.dstack([np.full_like(SEEN, 255)] * 3 + [SEEN])),
        lambda: Image.fromarray(np.dstack([np.full_like(SEEN, 255), SEEN]), "LA"),
        lambda: Image.fromarray(np.dstack([SEEN] * 3 + [np.full_like(SEEN, 255)])),
        lambda: Image.fromarray(np.dstack([SEEN // 255] * 3 + [SEEN])),
    ],
)
def test_what_is_hidden_stays_hidden_in_masks_of_any_kind(tmp_path, mask):
    mask().save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path, "mask.png"), ~HIDDEN)


@pytest.mark.parametrize("save", [{"format": "JPEG", "quality": 95}, {"format": "JPEG", "quality": 50},
                                  {"format": "WEBP", "quality": 50}])  # fmt: skip
@pytest.mark.parametrize("white", [255, 100])
def test_rings_of_lossy_masks_are_hidden(tmp_path, save, white):
    Image.fromarray(np.where(HIDDEN, 0, white).astype(np.uint8)).save(tmp_path / "mask", **save)
    seen = read_mask(tmp_path, "mask")
    assert (seen & HIDDEN).sum() <= 0.02 * HIDDEN.sum()
    assert (~seen & ~HIDDEN).sum() <= 0.02 * (~HIDDEN).sum()


def test_of_soft_edges_what_is_nearly_white_is_seen(tmp_path):
    step = np.clip(np.arange(WIDTH) * 20.0 - 200, 0, 255)
    Image.fromarray(np.tile(step, (HEIGHT, 1)).astype(np.uint8)).save(tmp_path / "mask.png")
    assert np.array_equal(read_mask(tmp_path, "mask.png")[0], step > 192)


# Distortion

LENSES = {
    "SIMPLE_RADIAL": (-0.15,),
    "RADIAL": (0.12, -0.03),
    "OPENCV": (-0.2, 0.03, 2e-3, -1e-3),
    "FULL_OPENCV": (0.1, 0.02, 1e-3, 1e-3, 0.01, 0.05, 0.01, 0.002),
    "OPENCV_FISHEYE": (0.03, -0.01, 0.002, -0.001),
    "RADIAL_FISHEYE": (0.02, -0.01),
}


def lens_pair(kind: str, width: int, height: int) -> tuple[Lens, pycolmap.Camera]:
    focals = [0.8 * width] if "RADIAL" in kind else [0.8 * width, 0.85 * width]
    center = [width / 2 + 1.25, height / 2 - 0.75]
    fisheye = kind.endswith("FISHEYE")
    values = LENSES[kind] + (0.0,) * ((4 if fisheye else 8) - len(LENSES[kind]))
    camera = pycolmap.Camera(model=kind, width=width, height=height, params=[*focals, *center, *LENSES[kind]])
    return Lens(width, height, focals[0], focals[-1], *center, values, fisheye), camera


def pixel_rays(lens: Lens) -> np.ndarray:
    """(x, y) of the rays (x, y, 1) through all pixel centres, float64 [height * width, 2]."""
    y, x = np.mgrid[: lens.height, : lens.width] + 0.5
    return np.stack([(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy], axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("kind", LENSES)
def test_undistorted_pixels_come_from_where_colmap_sees_them(tmp_path, kind):
    """The photo's red and green say the column and row, so each result pixel says where it came from. Blue is
    255: no pixel of the result is unseen."""
    width, height = 240, 180
    lens, camera = lens_pair(kind, width, height)
    flat = undistortion(lens)
    rows, columns = np.mgrid[:height, :width].astype(np.uint8)
    photo = saved(tmp_path / "p.png", np.stack([columns, rows, np.full_like(rows, 255)], axis=-1))
    image = Photos([PhotoSource(photo, lens.size, lens.size, flat)]).image(0).numpy()
    assert image.shape == (flat.pinhole.height, flat.pinhole.width, 3)
    assert (image[..., 2] == 255).mean() > 0.98
    assert flat.pinhole.width > 0.9 * lens.width
    assert not flat.pinhole.distorted
    rays = pixel_rays(flat.pinhole)
    expected = camera.img_from_cam(np.c_[rays, np.ones(len(rays))])
    assert np.abs(distort(lens, rays) - expected).max() < 1e-6
    # The photo ends at its outermost pixel centres; OpenCV's cropping is good to a pixel.
    expected = (expected - 0.5).clip(0, [width - 1, height - 1])
    error = image[..., :2].reshape(-1, 2) - expected
    inner = ((expected > 2) & (expected < [width - 3, height - 3])).all(axis=1)
    # Rounding to 8 bits is 1/2, OpenCV's steps of 1/32 px are 1/64; half a pixel mistaken gives 0.53 and up.
    assert np.abs(error[inner]).max() < 0.52
    assert inner.mean() > 0.9


def test_mask_is_undistorted_with_its_photo(tmp_path):
    lens, _ = lens_pair("OPENCV", 240, 180)
    flat = undistortion(lens)
    mask = np.full((180, 240), 255, np.uint8)
    mask[:, :120] = 0
    photo = saved(tmp_path / "p.png", np.repeat(mask[..., None], 3, axis=2))
    source = PhotoSource(photo, lens.size, lens.size, flat, saved(tmp_path / "m.png", mask))
    photos = Photos([source])
    assert photos.mask(0).shape == (*photos.image(0).shape[:2], 1)
    # What is used was white all through; half-way pixels are not used.
    assert (photos.image(0)[photos.mask(0)[..., 0]] == 255).all()
    assert 0.4 < photos.mask(0).float().mean() < 0.6
