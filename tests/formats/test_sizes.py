"""How large files would be: as large as those that are written."""

import sys

import pytest
import torch

from abcd_ns.engine.types import Gaussians
from abcd_ns.formats.glb import Z_TO_Y
from abcd_ns.formats.scene_file import write_scene
from abcd_ns.formats.sizes import ply_bytes, spz_bytes
from tests.reference.scenes import random_gaussians

SIZES = {".ply": ply_bytes, ".spz": spz_bytes}


@pytest.mark.parametrize("suffix", SIZES)
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_a_file_is_as_large_as_foretold(suffix, sh_degree, tmp_path):
    gaussians = random_gaussians(300, sh_degree=sh_degree, seed=1)
    path = tmp_path / f"scene{suffix}"
    write_scene(path, suffix, len(gaussians), sh_degree, Z_TO_Y, [gaussians])
    assert SIZES[suffix](gaussians) == path.stat().st_size


@pytest.mark.parametrize("suffix", SIZES)
def test_who_shows_nowhere_takes_no_room(suffix):
    shown = random_gaussians(300, sh_degree=3, seed=1)
    hidden = Gaussians(**{**dict(shown.items()), "opacities": torch.full_like(shown.opacities, -9.0)})
    assert SIZES[suffix](Gaussians.cat([shown, hidden])) == SIZES[suffix](shown)


def test_what_cannot_be_packed_has_no_size(monkeypatch):
    gaussians = random_gaussians(10, sh_degree=1, seed=1)
    assert spz_bytes(gaussians[:0]) is None
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    assert spz_bytes(gaussians) is None
