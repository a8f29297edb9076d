"""A layer is found only where every pixel of it would be drawn the same."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.storage import LayerKey, view_fingerprint
from abcd_ns.engine.types import Crop, View


def key(prefix: str = "") -> LayerKey:
    return LayerKey(
        scene="scene",
        view="view 0",
        crop=Crop(0, 16, 4, 4),
        content=((1, 2), (3, 4), "far"),
        sh_degree=3,
        raster_mode="classic",
        rasterizer="torch-1",
        bits=16,
        prefix=prefix,
    )


def test_everything_that_changes_a_pixel_changes_the_digest():
    base = key()
    others = [
        replace(base, scene="other"),
        replace(base, view="other"),
        replace(base, crop=Crop(16, 0, 4, 4)),
        replace(base, content=((1, 2), (3, 5), "far")),
        replace(base, content=((3, 4), (1, 2), "far")),
        replace(base, content=((1, 2), (3, 4), "near")),
        replace(base, sh_degree=2),
        replace(base, raster_mode="antialiased"),
        replace(base, rasterizer="gsplat-1.4.0"),
        replace(base, bits=32),
        replace(base, format=2),
    ]
    assert len({k.digest() for k in [base, *others]}) == len(others) + 1
    assert replace(base, prefix="visit-3").digest() == base.digest() == key().digest()
    # Across processes and releases: a digest that changes silently would waste every cache on disk.
    assert base.digest().hex() == "6a9e6ca91b4cff4a48aeb75b039361976a1952fcddee86ebf6522a52420140c5"


def test_a_view_is_known_by_pose_k_and_size():
    base = View(torch.eye(4), torch.eye(3), 8, 6, index=1)
    nudged = torch.eye(4)
    nudged[0, 3] = torch.nextafter(torch.tensor(0.0), torch.tensor(1.0))
    others = [
        replace(base, viewmat=nudged),
        replace(base, K=2 * torch.eye(3)),
        replace(base, width=6, height=8),
        base.to(torch.float64),
    ]
    assert len({view_fingerprint(v) for v in [base, *others]}) == 5
    assert view_fingerprint(replace(base, index=2)) == view_fingerprint(base)


@pytest.mark.parametrize("prefix", ["a\0b", "a b", "é", "x" * 101])
def test_a_prefix_is_short_and_printable(prefix):
    with pytest.raises(ValueError, match="prefix"):
        key(prefix=prefix)
