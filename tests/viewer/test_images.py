import base64
import io

import numpy as np
from PIL import Image

from abcd_ns.viewer.images import photo_image


def test_a_photo_is_reduced_to_the_panel():
    photo = np.zeros((1000, 2000, 4), np.uint8)
    photo[:, 1000:] = 255
    start, _, content = photo_image(photo, "00.png").partition(",")
    assert start == "![00.png](data:image/jpeg;base64"
    shown = Image.open(io.BytesIO(base64.b64decode(content.removesuffix(")"))))
    assert shown.size == (520, 260)
    assert shown.getpixel((10, 10)) == (0, 0, 0)
    assert shown.getpixel((500, 10)) == (255, 255, 255)
