"""Clouds as scanners and photogrammetry write them: colours of any type, range and name."""

import numpy as np
import pytest

from abcd_ns.data.input_errors import InputError
from abcd_ns.data.ply import read_points
from tests.data.dataparser_scenes import XYZ, parser, write_cloud, write_transforms

RGB = np.array([[0, 128, 255], [10, 20, 30], [255, 255, 255], [90, 0, 3]])
NAMES = ("red", "green", "blue")


@pytest.mark.parametrize("names", [NAMES, ("diffuse_red", "diffuse_green", "diffuse_blue"), ("R", "G", "B")])
@pytest.mark.parametrize(
    ("kind", "white"),
    [("uchar", 255), ("ushort", 65_535), ("int16", 255), ("uint", 65_535), ("uint32", 2**32 - 1)]
    + [(kind, white) for kind in ("float", "double") for white in (1, 255, 65_535)],
)
def test_colors_are_read_by_type_and_range(tmp_path, kind, white, names):
    rgb = RGB / 255 * white if kind in ("float", "double") else RGB * white // 255
    xyz, found = read_points(write_cloud(tmp_path / "points.ply", kind, rgb, names))
    assert np.array_equal(xyz, XYZ)
    assert np.array_equal(found, RGB)


@pytest.mark.parametrize("white", [1, 255])
def test_real_colors_above_white_are_clipped(tmp_path, white):
    rgb = np.where(RGB == 255, 1.02 * white, RGB / 255 * white)
    rgb[0, 0] = np.nan
    assert np.array_equal(read_points(write_cloud(tmp_path / "points.ply", "float", rgb))[1], RGB)


def test_gaussians_are_points_of_their_mean_color(tmp_path):
    harmonics = (RGB / 255 - 0.5) / 0.28209479177387814
    path = write_cloud(tmp_path / "points.ply", "float", harmonics, ("f_dc_0", "f_dc_1", "f_dc_2"))
    assert np.array_equal(read_points(path)[1], RGB)


def test_points_without_colors_are_grey_and_it_is_said(scene, capsys):
    write_transforms(scene)
    write_cloud(scene / "points.ply", "float", RGB, ("a", "b", "c"))
    points = parser(scene).get_dataparser_outputs().metadata
    assert (points["points3D_rgb"] == 127).all()
    assert "the points have no colours" in capsys.readouterr().out


def test_a_cloud_may_stand_for_a_models_points(scene):
    (scene / "sparse/0/points3D.bin").unlink()
    write_cloud(scene / "sparse/0/points3D.ply", "uchar", RGB)
    assert np.array_equal(parser(scene).get_dataparser_outputs().metadata["points3D_rgb"], RGB)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_clouds(tmp_path, order):
    row = [(name, order + "f8") for name in "xyz"] + [(name, "u1") for name in NAMES]
    table = np.array([(*p, *c) for p, c in zip(XYZ, RGB, strict=True)], dtype=row)
    path = write_cloud(tmp_path / "points.ply", "uchar", RGB)
    form = f"format binary_{'little' if order == '<' else 'big'}_endian 1.0\n"
    head, end, _ = path.read_text().replace("format ascii 1.0\n", form).partition("end_header\n")
    head = (head + end).encode()
    path.write_bytes(head + table.tobytes())
    assert np.array_equal(read_points(path)[0], XYZ)
    assert np.array_equal(read_points(path)[1], RGB)
    for broken in (
        head + table.tobytes()[:-1],
        head + table.tobytes() + b"!",
        b"",
        head.replace(form.encode(), b"") + table.tobytes(),
        head.replace(b"4\n", b"-4\n"),
        head.replace(b"4\n", b"1152921504606846976\n") + table.tobytes(),
        head.replace(b"4\n", b"9" * 5000 + b"\n") + table.tobytes(),
    ):
        path.write_bytes(broken)
        with pytest.raises(InputError, match=r"points\.ply"):
            read_points(path)


def test_a_comment_may_name_the_headers_end(tmp_path):
    path = write_cloud(tmp_path / "points.ply", "uchar", RGB)
    path.write_text(path.read_text().replace("element", "comment before end_header\nelement", 1))
    assert np.array_equal(read_points(path)[0], XYZ)
