"""`abcd export` to formats other than .ply: independent readers find the scene in them."""

import gzip
import io
import json
import struct
import sys
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from plyfile import PlyData
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from abcd_ns.cli.export import export
from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.glb import EXTENSION, Z_TO_Y, write_glb
from abcd_ns.formats.ply import Content
from abcd_ns.formats.scene_file import SUFFIXES, ply_bytes, spz_bytes, suffix_of, write_scene
from abcd_ns.run.store import MadeFor
from tests.cli.test_export import FRAME, run, scene, write_run  # noqa: F401
from tests.reference.scenes import random_gaussians


def write(path, gaussians, suffix, parts=2, up=Z_TO_Y):
    pieces = (gaussians[rows] for rows in torch.arange(len(gaussians)).chunk(parts))
    write_scene(path, suffix, up, Content(len(gaussians), gaussians.sh_degree, pieces))
    return path


def in_order_of(found: np.ndarray, means: torch.Tensor, within: float) -> np.ndarray:
    """Which row of `found` lies at each mean: each at one, none further than `within`."""
    distance, row = cKDTree(found).query(means.numpy())
    assert len(found) == len(means) == len(set(row))
    assert distance.max() <= within
    return row


def off(found: np.ndarray, wanted: torch.Tensor) -> float:
    return float(np.abs(found - wanted.numpy()).max())


# -- glTF ----------------------------------------------------------------------------------------------


def read_glb(path) -> tuple[dict, dict[str, np.ndarray]]:
    """The document, and the attributes of its one primitive; after the glTF 2.0 specification."""
    content = path.read_bytes()
    magic, version, length, words, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    document = json.loads(content[20 : 20 + words])
    size, kind = struct.unpack_from("<I4s", content, 20 + words)
    assert (kind, size, words % 4, size % 4) == (b"BIN\0", document["buffers"][0]["byteLength"], 0, 0)
    body, found = content[28 + words :], {}
    assert len(body) == size
    for name, number in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        values = np.frombuffer(body, kind, accessor["count"] * width, view["byteOffset"])
        assert values.nbytes == view["byteLength"]
        found[name] = values.reshape(-1, width)
    return document, found


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(count=st.integers(1, 60), seed=st.integers(0, 99), degree=st.integers(0, 3), parts=st.integers(1, 4))
def test_a_glb_holds_the_scene_in_the_units_of_the_extension(tmp_path, count, seed, degree, parts):
    made = random_gaussians(count, seed, sh_degree=degree)
    document, found = read_glb(write(tmp_path / "scene.glb", made, ".glb", parts))
    assert np.array_equal(found["POSITION"], made.means.numpy())
    box = document["accessors"][0]
    assert box["min"] == made.means.amin(0).tolist()
    assert box["max"] == made.means.amax(0).tolist()
    assert np.allclose(found[f"{EXTENSION}:SCALE"], np.exp(made.scales.numpy()), rtol=1e-6)
    assert np.allclose(found[f"{EXTENSION}:OPACITY"], 1 / (1 + np.exp(-made.opacities.numpy())), rtol=1e-6)
    quats = made.quats / made.quats.norm(dim=1, keepdim=True)
    assert off(found[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]], quats) < 1e-6
    assert np.array_equal(found[f"{EXTENSION}:SH_DEGREE_0_COEF_0"], made.features_dc.numpy())
    harmonics = [name for name in found if ":SH_DEGREE_" in name]
    wanted = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
    assert harmonics == wanted
    for k, name in enumerate(wanted[1:]):
        assert np.array_equal(found[name], made.features_rest[:, k].numpy())
    shown = (made.features_dc * SH_C0 + 0.5).clamp(0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    assert np.abs(found["COLOR_0"][:, :3] / 255 - linear).max() < 0.5 / 255 + 1e-6
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert primitive["extensions"] == {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    assert document["extensionsUsed"] == [EXTENSION]


@pytest.mark.parametrize("frame", ["data", "nerfstudio"])
def test_a_glb_stands_upright_in_either_frame(run, scene, tmp_path, frame):  # noqa: F811
    export(run, out=tmp_path / "scene.glb", frame=frame)
    document, found = read_glb(tmp_path / "scene.glb")
    (node,) = document["nodes"]
    up_in_run = torch.tensor([[0.0, 0, 0], [0, 0, 1]], dtype=torch.float64)
    low, high = (up_in_run if frame == "nerfstudio" else FRAME.inverse.points(up_in_run)).numpy()
    risen = Rotation.from_quat(node["rotation"]).apply(high - low)
    assert np.allclose(risen / np.linalg.norm(risen), [0, 1, 0], atol=1e-6)
    assert len(found["POSITION"]) == len(scene) - 1


def test_more_than_a_glb_can_hold_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"and a \.glb holds 4; use --by-block"):
        write_glb(tmp_path / "large.glb", Z_TO_Y, Content(20_000_000, 3, []))
    assert list(tmp_path.iterdir()) == []


# -- packed ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cloud():
    return random_gaussians(400, sh_degree=3)


def test_spz_is_read_by_its_description(cloud, tmp_path):
    """nianticlabs/spz, README: columns of fixed widths, one attribute after the other. Axes are right, up and
    back, .ply's right, down and front; splat-transform 2.7.1 reads both so."""
    raw = gzip.decompress(write(tmp_path / "scene.spz", cloud, ".spz").read_bytes())
    magic, version, count, degree, fraction = struct.unpack_from("<IIIBB", raw)
    assert (magic, version, count, degree) == (0x5053474E, 3, len(cloud), 3)
    columns, start = {}, 16
    for name, width in (("means", 9), ("alpha", 1), ("color", 3), ("scale", 3), ("quat", 4), ("sh", 45)):
        columns[name] = np.frombuffer(raw, "u1", count * width, start).reshape(count, width).astype(float)
        start += count * width
    assert start == len(raw)
    digits = columns["means"].reshape(count, 3, 3) @ [1, 256, 65536]
    means = np.where(digits < 1 << 23, digits, digits - (1 << 24)) / (1 << fraction) * [1, -1, -1]
    row = in_order_of(means, cloud.means, 0.87 / 4096)
    assert off(columns["alpha"][row] / 255, cloud.opacities.sigmoid()) < 0.51 / 255
    assert off(columns["scale"][row] / 16 - 10, cloud.scales) < 0.51 / 16
    color = ((columns["color"][row] / 255 - 0.5) / 0.15).clip(-3.2, 3.2)
    assert off(color, cloud.features_dc.clamp(-3.2, 3.2)) < 0.015
    # As y and z change sign, so do harmonics that are odd in them (gsplat's order: -y, z, -x, xy, ...).
    odd = [1, 1, 0, 1, 0, 0, 1, 0, 1, 0, 1, 1, 0, 1, 0]
    signs = np.where(odd, -1, 1)[:, None]
    harmonics = (columns["sh"][row].reshape(count, 15, 3) - 128) / 128 * signs
    assert off(harmonics, cloud.features_rest.clamp(-1, 127 / 128)) <= 8.5 / 128


def test_compressed_ply_is_read_by_its_properties(cloud, tmp_path):
    """Chunks of 256 with their bounds; harmonics a byte each, channel by channel as in .ply."""
    found = PlyData.read(str(write(tmp_path / "scene.compressed.ply", cloud, ".compressed.ply")))
    vertex, chunks, harmonics = (found[name].data for name in ("vertex", "chunk", "sh"))
    chunk, packed = np.arange(len(vertex)) // 256, vertex["packed_position"]
    low, high = (np.stack([chunks[f"{end}_{a}"] for a in "xyz"], axis=1)[chunk] for end in ("min", "max"))
    steps = np.stack([(packed >> 21) / 2047, ((packed >> 11) & 1023) / 1023, (packed & 2047) / 2047], axis=1)
    row = in_order_of(low + steps * (high - low), cloud.means, 2 / 1023)
    rest = np.stack([harmonics[f"f_rest_{k}"] for k in range(45)], axis=1)[row].astype(float)
    assert off((rest / 256 - 0.5) * 8, cloud.features_rest.transpose(1, 2).flatten(1)) <= 8 / 256
    assert off((vertex["packed_color"][row] & 255) / 255, cloud.opacities.sigmoid()[:, 0]) < 0.51 / 255


def test_sog_is_read_by_its_pictures(cloud, tmp_path):
    """playcanvas, the SOG format: a zip of lossless WebP pictures, a pixel a Gaussian, and meta.json."""
    with zipfile.ZipFile(write(tmp_path / "scene.sog", cloud, ".sog")) as files:
        meta = json.loads(files.read("meta.json"))

        def pixels(name: str) -> np.ndarray:
            picture = Image.open(io.BytesIO(files.read(name)))
            return np.asarray(picture.convert("RGBA")).reshape(-1, 4)[: len(cloud)].astype(int)

        fine = pixels("means_l.webp")[:, :3] + 256 * pixels("means_u.webp")[:, :3]
        color, size, labels = pixels("sh0.webp"), pixels("scales.webp")[:, :3], pixels("shN_labels.webp")
        centroids = np.asarray(Image.open(io.BytesIO(files.read("shN_centroids.webp"))).convert("RGB"))
    assert meta["count"] == len(cloud)
    low, high = (np.array(meta["means"][end]) for end in ("mins", "maxs"))
    logs = low + fine / 65535 * (high - low)
    row = in_order_of(np.sign(logs) * np.expm1(np.abs(logs)), cloud.means, 1e-4)
    assert off(color[row, 3:] / 255, cloud.opacities.sigmoid()) < 0.51 / 255
    assert off(np.array(meta["sh0"]["codebook"])[color[row, :3]], cloud.features_dc) < 0.05
    assert off(np.array(meta["scales"]["codebook"])[size[row]], cloud.scales) < 0.05
    label = (labels[:, 0] + 256 * labels[:, 1])[row]
    harmonics = centroids[(label // 64)[:, None], (label % 64)[:, None] * 15 + np.arange(15)]
    assert off(np.array(meta["shN"]["codebook"])[harmonics], cloud.features_rest) < 0.05


@pytest.mark.parametrize("suffix", [".spz", ".compressed.ply", ".sog"])
def test_scenes_of_lower_degree_are_packed_too(tmp_path, suffix):
    import gaussforge

    path = write(tmp_path / f"scene{suffix}", random_gaussians(50, sh_degree=1), suffix)
    back = gaussforge.GaussForge().convert(path.read_bytes(), suffix[1:], "ply")
    assert b"element vertex 50\n" in back["data"]


# -- the command -------------------------------------------------------------------------------------------


def test_the_suffix_chooses_and_what_it_takes_is_said(run, tmp_path, capsys):  # noqa: F811
    assert export(run, out=tmp_path / "scene.spz") == 0
    said = capsys.readouterr().out
    assert ".spz is packed at once, in about 0.29 MiB of RAM" in said
    assert "299 Gaussians" in said
    assert export(run, out=tmp_path / "parts.glb", by_block=True) == 0
    files = sorted((tmp_path / "parts.glb").iterdir())
    assert [file.name for file in files] == [f"block-{n:04d}.glb" for n in range(1, 6)]
    assert sum(len(read_glb(file)[1]["POSITION"]) for file in files) == 299


def marked(path) -> bool:
    """Whether a file says that its Gaussians were trained antialiased, where readers of its format look."""
    content = path.read_bytes()
    if path.suffix == ".ply":
        return any("antialiased" in comment for comment in PlyData.read(str(path)).comments)
    if path.suffix == ".spz":  # nianticlabs/spz: bit 0 of the flags
        return gzip.decompress(content)[14] & 1 == 1
    if path.suffix == ".sog":
        return json.loads(zipfile.ZipFile(io.BytesIO(content)).read("meta.json"))["antialias"]
    primitive = read_glb(path)[0]["meshes"][0]["primitives"][0]
    return primitive.get("extras", {}).get("antialiased", False)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_antialiased_runs_are_marked(run, scene, tmp_path, suffix, capsys):  # noqa: F811
    header = MadeFor("0", [0.0, 0.0, 0.0], "in turn", 3, "3dgs", antialiased=True).header()
    plain, made = (tmp_path / f"{name}{suffix}" for name in ("plain", "made"))
    export(run, out=plain)
    assert not marked(plain)
    assert "Trained antialiased" not in capsys.readouterr().out
    export(write_run(tmp_path / "other", scene, **header), out=made)
    assert marked(made)
    assert "enable antialiasing in the viewer" in capsys.readouterr().out
    if suffix == ".sog":  # no time of its own, by which the same scene would be two files
        assert len({file.date_time for f in (plain, made) for file in zipfile.ZipFile(f).infolist()}) == 1
    if suffix in (".spz", ".sog", ".compressed.ply"):
        import gaussforge

        plys = (gaussforge.GaussForge().convert(f.read_bytes(), suffix[1:], "ply") for f in (plain, made))
        assert len({found["data"] for found in plys}) == 1


def test_suffixes_are_told_apart_and_others_refused(tmp_path):
    for suffix in SUFFIXES:
        assert suffix_of(tmp_path / f"a.b{suffix.upper()}") == suffix
    assert suffix_of(tmp_path / "parts", ".ply") == ".ply"
    with pytest.raises(UserError, match=r"must end in one of \.compressed\.ply, \.glb, \.ply, \.sog, \.spz"):
        suffix_of(tmp_path / "scene.obj")


def test_without_the_package_one_line_says_what_to_install(run, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    with pytest.raises(UserError, match=r"pip install 'abcd-ns\[export\]'"):
        export(run, out=tmp_path / "scene.sog")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]
    assert export(run, out=tmp_path / "scene.glb") == 0


def test_spz_says_where_it_is_too_coarse_or_too_small(run, tmp_path, capsys):  # noqa: F811
    path = run / "dataparser_transforms.json"
    known = json.loads(path.read_text())
    path.write_text(json.dumps({**known, "scale": known["scale"] * 1000}))
    export(run, out=tmp_path / "tiny.spz")
    assert ".sog and .ply are finer" in capsys.readouterr().out
    path.write_text(json.dumps({**known, "scale": known["scale"] / 1000}))
    with pytest.raises(UserError, match=r"\.spz reaches 2048 units .*--frame nerfstudio"):
        export(run, out=tmp_path / "huge.spz")
    with pytest.raises(UserError, match="reaches 2048 units"):
        export(run, out=tmp_path / "huge-parts.spz", by_block=True)
    assert not list(tmp_path.glob("huge*"))


# -- sizes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("suffix", "size"), [(".ply", ply_bytes), (".spz", spz_bytes)])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_a_file_is_as_large_as_foretold(suffix, size, sh_degree, tmp_path):
    """Without Gaussians that show nowhere."""
    shown = random_gaussians(300, sh_degree=sh_degree, seed=1)
    hidden = Gaussians(**{**dict(shown.items()), "opacities": torch.full_like(shown.opacities, -9.0)})
    path = write(tmp_path / f"scene{suffix}", shown, suffix)
    assert size(Gaussians.cat([shown, hidden])) == path.stat().st_size


def test_what_cannot_be_packed_has_no_size(monkeypatch):
    gaussians = random_gaussians(10, sh_degree=1, seed=1)
    assert spz_bytes(gaussians[:0]) is None
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    assert spz_bytes(gaussians) is None
