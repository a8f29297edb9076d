"""A land as a data set: its points lie where its pictures show them, in their colours."""

import numpy as np
import pytest
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from PIL import Image

from abcd_ns.errors import UserError
from benchmarks.land import Args, main


def test_points_have_the_colours_of_the_pixels_that_show_them(tmp_path):
    args = Args(tmp_path / "land", tiles=2, views=2, points=30, width=64, height=48)
    main(args)
    _, images, points = colmap.read_model(args.out / "sparse" / "0", ".bin")
    assert (len(images), len(points)) == (4, 60)
    off, shown = [], 0
    for image in images.values():
        photo = np.asarray(Image.open(args.out / "images" / image.name)).astype(int)
        for (x, y), point in zip(image.xys, image.point3D_ids, strict=True):
            off.append(np.abs(photo[int(y), int(x)] - points[int(point)].rgb).max())
            shown += 1
    assert shown > 60
    assert np.median(off) < 8  # of 255: within half a pixel of the very place
    with pytest.raises(UserError, match="is there already"):
        main(args)
