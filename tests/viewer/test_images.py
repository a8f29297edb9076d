import base64
import io

import numpy as np
from PIL import Image

from abcd_ns.viewer.images import photo_image


def content(image: str, name: str, kind: str) -> bytes:
    before, after = f"![{name}](data:image/{kind};base64,", ")"
    assert image.startswith(before)
    return base64.b64decode(image.removeprefix(before).removesuffix(after))


def test_a_photo_is_reduced_to_the_panel():
    photo = np.zeros((1000, 2000, 4), np.uint8)
    photo[:, 1000:] = 255
    shown = Image.open(io.BytesIO(content(photo_image(photo, "00.png"), "00.png", "jpeg")))
    assert shown.size == (520, 260)
    assert shown.getpixel((10, 10)) == (0, 0, 0)
    assert shown.getpixel((500, 10)) == (255, 255, 255)
