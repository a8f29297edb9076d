"""Images in the panel."""

import base64
import io
from xml.etree import ElementTree

import numpy as np
from PIL import Image

from abcd_ns.viewer.images import curve_image, photo_image


def content(image: str, name: str, kind: str) -> bytes:
    before, after = f"![{name}](data:image/{kind};base64,", ")"
    assert image.startswith(before)
    return base64.b64decode(image.removeprefix(before).removesuffix(after))


def test_a_curve_is_a_small_picture_with_numbers_on_its_axes():
    svg = content(curve_image([(0.0, 12.3), (97.0, 23.4)], "quality"), "quality", "svg+xml")
    assert len(svg) < 20_000
    labels = {text.text for text in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")}
    assert {"0", "100", "20"} <= labels
    assert curve_image([(0.0, 1.0)], "quality") == "Nothing to show yet."


def test_a_photo_is_reduced_to_the_panel():
    photo = np.zeros((1000, 2000, 4), np.uint8)
    photo[:, 1000:] = 255
    shown = Image.open(io.BytesIO(content(photo_image(photo, "00.png"), "00.png", "jpeg")))
    assert shown.size == (520, 260)
    assert shown.getpixel((10, 10)) == (0, 0, 0)
    assert shown.getpixel((500, 10)) == (255, 255, 255)
