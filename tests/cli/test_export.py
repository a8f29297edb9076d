"""`abcd export`: what an independent reader finds in the files is the scene."""

import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData

from abcd_ns.cli.export import TRANSFORMS, export, tell_rounding
from abcd_ns.engine.gaussians.block_state import BlockState, Packed
from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.coarse_model import stored_blocks
from abcd_ns.engine.store.special_blocks import PENDING
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.errors import UserError
from abcd_ns.formats.packed import WIDEST_SPZ
from tests.reference.scenes import random_gaussians

BLOCKS = 5
ROTATION = torch.linalg.qr(torch.tensor([[1.0, 2, 3], [-1, 1, 0.5], [0, 2, -1]], dtype=torch.float64))[0]
ROTATION = ROTATION * torch.linalg.det(ROTATION).sign()
FRAME = Similarity(ROTATION, torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64), 0.04)


@pytest.fixture
def scene():
    found = random_gaussians(300, sh_degree=3)
    found.opacities[7] = -12.0  # no rasterizer draws it
    return found


@pytest.fixture
def run(scene, tmp_path):
    return write_run(tmp_path / "run", scene)


def write_store(folder, scene, blocks, **header):
    """The store in a run's folder."""
    tree = build_kd(scene.means, blocks)
    folder.mkdir(exist_ok=True)
    with ParameterStore.create(folder / "abcd/store", {"tree": tree.to_json(), **header}) as store:
        store.commit(stored_blocks(tree, scene), state=RunState().to_json())


def write_run(folder, scene, **header):
    """A run's folder, as far as exporting goes."""
    write_store(folder, scene, BLOCKS, **header)
    matrix = torch.cat((FRAME.rotation, FRAME.translation[:, None]), dim=1)
    (folder / TRANSFORMS).write_text(json.dumps({"transform": matrix.tolist(), "scale": FRAME.scale}))
    return folder


@pytest.fixture
def exported(run, tmp_path):
    """`exported(option=...)` is what another reader finds in the .ply of `abcd export`."""
    path = tmp_path / "scene.ply"

    def vertices(**options) -> np.ndarray:
        path.unlink(missing_ok=True)
        assert export(run, out=path, **options) == 0
        return read(path)

    return vertices


def read(path) -> np.ndarray:
    return PlyData.read(str(path))["vertex"].data


def positions(vertices) -> np.ndarray:
    return np.stack([vertices[axis] for axis in "xyz"], axis=1)


def by_position(vertices) -> np.ndarray:
    return vertices[np.lexsort([vertices[axis] for axis in "xyz"])]


def change_block(run, change) -> None:
    """Commit what `change` makes of the state of block 0."""
    with ParameterStore.open(run / "abcd/store") as store:
        state = BlockState.unpacked(Packed(*store.load(0)))
        store.commit({name: part.packed() for name, part in change(state).items()})


def test_those_that_wait_for_their_blocks_next_visit_are_exported(run, exported):
    before = by_position(exported())
    change_block(run, lambda state: {0: state[3:], PENDING: state[:3]})
    assert np.array_equal(before, by_position(exported()))


def test_those_that_nobody_sees_yet_are_left_out(run, exported):
    before = exported()
    change_block(run, lambda state: {0: replace(state, deferred=torch.arange(len(state)) < 3)})
    waiting = exported()
    change_block(run, lambda state: {0: state[3:]})
    assert len(waiting) == len(before) - 3
    assert np.array_equal(waiting, exported())


def test_in_the_runs_own_frame_every_value_is_what_is_stored(exported, scene, capsys):
    found = by_position(exported(frame="nerfstudio"))
    assert "1 Gaussian too transparent to be drawn left out." in capsys.readouterr().out
    kept = scene[torch.arange(len(scene)) != 7]
    kept = kept[torch.from_numpy(np.lexsort(kept.means.T.numpy()))]
    assert np.array_equal(positions(found), kept.means.numpy())
    assert np.array_equal(found["opacity"], kept.opacities[:, 0].numpy())
    assert np.array_equal(found["scale_2"], kept.scales[:, 2].numpy())
    assert np.array_equal(found["f_dc_1"], kept.features_dc[:, 1].numpy())
    # Fifteen of red, fifteen of green, fifteen of blue.
    assert np.array_equal(found["f_rest_17"], kept.features_rest[:, 2, 1].numpy())
    quats = torch.nn.functional.normalize(kept.quats, dim=1)
    assert np.allclose(found["rot_0"], quats[:, 0], atol=1e-6)


def test_the_datas_frame_is_where_the_photos_were_posed(exported, scene, capsys):
    found, own = exported(), exported(frame="nerfstudio")
    back = FRAME.points(torch.from_numpy(positions(found)))
    distances = torch.cdist(back, scene.means.double()).min(dim=1).values
    assert len(found) == len(scene) - 1
    assert float(distances.max()) < 1e-5
    assert np.allclose(np.sort(found["scale_0"]), np.sort(own["scale_0"]) - math.log(FRAME.scale), atol=1e-5)
    assert "299 Gaussians" in capsys.readouterr().out


def test_the_blocks_files_together_are_the_scene(run, exported, tmp_path):
    export(run / "config.yml", out=tmp_path / "parts", by_block=True, frame="nerfstudio")
    parts = sorted((tmp_path / "parts").iterdir())
    assert [path.name for path in parts] == [f"block-{n:04d}.ply" for n in range(1, BLOCKS + 1)]
    together = by_position(np.concatenate([read(path) for path in parts]))
    assert np.array_equal(together, by_position(exported(frame="nerfstudio")))


@pytest.mark.parametrize("frame", ["data", "nerfstudio"])
def test_a_box_holds_what_lies_in_it(exported, frame):
    everything = positions(exported(frame=frame))
    low, high = np.quantile(everything, [0.2, 0.7], axis=0)
    found = positions(exported(box=(*low, *high), frame=frame))
    inside = ((everything >= low) & (everything < high)).all(axis=1)
    assert 0 < len(found) < len(everything)
    assert np.array_equal(found, everything[inside])


def test_far_from_the_origin_lost_digits_are_told(run, exported, capsys):
    path = run / TRANSFORMS
    far = json.loads(path.read_text())
    for row, offset in zip(far["transform"], (5e5, 4e6, 100.0), strict=True):
        row[3] -= offset
    path.write_text(json.dumps(far))
    exported()
    said = capsys.readouterr().out
    assert "rounds positions to 0." in said
    assert "--frame nerfstudio" in said
    tell_rounding(".ply", largest=5e6, size=0.0)  # a single Gaussian has no size to lose digits of
    assert capsys.readouterr().out == ""


def test_sizes_that_spz_cuts_are_told_and_are_what_its_reader_finds(tmp_path, scene, capsys):
    scene.scales[3] = 7.0
    run = write_run(tmp_path / "run", scene)
    export(run, out=tmp_path / "wide.spz", frame="nerfstudio")
    said = f"up to {math.exp(7):,.0f} units wide, .spz holds {WIDEST_SPZ:.0f} at most"
    assert said in capsys.readouterr().out
    gaussforge = pytest.importorskip("gaussforge")
    back = gaussforge.GaussForge().convert((tmp_path / "wide.spz").read_bytes(), "spz", "ply")["data"]
    assert PlyData.read(io.BytesIO(back))["vertex"]["scale_0"].max() == pytest.approx(math.log(WIDEST_SPZ))


def test_wrong_requests_are_refused_and_leave_nothing(run, tmp_path):
    (run / TRANSFORMS).write_text("{}")
    for words, options in {
        "no Gaussian to export in this box": {"box": (90.0, 90.0, 90.0, 91.0, 91.0, 91.0)},
        "Y0 < Y1": {"box": (0.0, 0.0, 0.0, 1.0, -1.0, 1.0)},
        "exists already": {"out": run},
        "cannot be read": {"frame": "data"},
    }.items():
        with pytest.raises(UserError, match=words):
            export(run, **{"out": tmp_path / "new.ply", "frame": "nerfstudio", **options})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]


def test_a_run_in_its_warm_up_has_nothing_to_show_yet(run, tmp_path):
    with ParameterStore.open(run / "abcd/store") as store:
        store.commit({}, state={})
    with pytest.raises(UserError, match="warm-up"):
        export(run, out=tmp_path / "new.ply")


@pytest.mark.parametrize("gone", [True, False])
def test_a_shard_that_is_damaged_or_gone_is_one_line(run, tmp_path, gone):
    shard = sorted((run / "abcd/store").glob("*.safetensors"))[1]
    if gone:
        shard.unlink()
    else:
        content = bytearray(shard.read_bytes())
        content[-9] ^= 1
        shard.write_bytes(content)
    with pytest.raises(UserError, match="If the run is training, wait"):
        export(run, out=tmp_path / "new.ply")
    assert not (tmp_path / "new.ply").exists()
