"""The synthetic scene: a valid COLMAP model of pictures that look like a place, the same bytes every time."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from abcd_ns.errors import UserError
from abcd_ns.lab.synth.cameras import Camera, Lens, court_cameras, look_at
from abcd_ns.lab.synth.command import Settings, synth
from abcd_ns.lab.synth.court import Site, build_court
from abcd_ns.lab.synth.geometry import Soup, box, lathe
from abcd_ns.lab.synth.lighting import tone_map
from abcd_ns.lab.synth.raycast import Caster
from abcd_ns.lab.synth.render import render
from abcd_ns.lab.synth.textures import KINDS, Material, MaterialTable
from abcd_ns.lab.synth.walls import INNER
from abcd_ns.lab.synth.world import World

TINY = {"courts": 2, "views_per_court": 6, "width": 48, "height": 36, "points_per_court": 300}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below `folder`."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "two"
    synth(out, Settings(**TINY))
    return out


@pytest.fixture(scope="module")
def model(scene: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(scene / "sparse" / "0"))


def picture(scene: Path, name: str) -> np.ndarray:
    return np.asarray(Image.open(scene / "images" / name), np.float64)


def test_same_settings_give_same_bytes(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    synth(tmp_path / "again", Settings(**TINY))
    assert contents(tmp_path / "again") == contents(scene)


def test_seed_changes_the_scene(scene: Path, tmp_path: Path) -> None:
    synth(tmp_path / "other", Settings(**TINY, seed=1))
    mine, other = contents(scene), contents(tmp_path / "other")
    assert mine.keys() == other.keys()
    assert all(mine[name] != other[name] for name in mine if name.endswith(".png"))


def test_pycolmap_reads_back_what_was_asked_for(scene: Path, model: pycolmap.Reconstruction) -> None:
    assert model.num_images() == model.num_reg_images() == 12
    assert model.num_cameras() == 1
    camera = model.cameras[1]
    assert (camera.model.name, camera.width, camera.height) == ("PINHOLE", 48, 36)
    assert 400 <= model.num_points3D() <= 600
    names = [model.images[i].name for i in sorted(model.images)]
    assert names == sorted(p.name for p in (scene / "images").iterdir())
    assert "abcd synth OUT --courts 2" in (scene / "SOURCE.md").read_text()


def test_tracks_and_observations_agree_and_reproject(model: pycolmap.Reconstruction) -> None:
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-9
    total = 0
    for number, point in model.points3D.items():
        images = [e.image_id for e in point.track.elements]
        assert len(set(images)) == len(images) >= 2
        for element in point.track.elements:
            seen = model.images[element.image_id].points2D[element.point2D_idx]
            assert seen.point3D_id == number
        total += len(images)
    assert total == sum(image.num_points3D for image in model.images.values())


def test_points_have_the_colours_of_their_pixels(scene: Path, model: pycolmap.Reconstruction) -> None:
    """Only right if poses, intrinsics, pixel centres, visibility and colours all agree with the pictures."""
    near, far = [], []
    rng = np.random.default_rng(0)
    for image in model.images.values():
        pixels = picture(scene, image.name)
        for seen in image.points2D:
            color = model.points3D[seen.point3D_id].color
            column, row = (int(v) for v in seen.xy)
            near.append(np.abs(pixels[row, column] - color).mean())
            far.append(np.abs(pixels[rng.integers(36), rng.integers(48)] - color).mean())
    assert np.median(near) < 8
    assert np.mean(near) < 0.4 * np.mean(far)


def test_some_points_lie_on_the_dome_and_most_do_not(model: pycolmap.Reconstruction) -> None:
    radius = np.array([np.linalg.norm(p.xyz) for p in model.points3D.values()])
    on_dome = np.abs(radius - 60.0) < 0.1
    assert 0.01 < on_dome.mean() < 0.2
    assert radius.max() < 60.1


def test_cameras_look_into_their_court_from_above_its_walls_and_upright(
    model: pycolmap.Reconstruction,
) -> None:
    site = Site.plan(2, "grid", 0)
    for image in model.images.values():
        middle = site.center(int(image.name[len("court") :][:3]))
        center, turn = image.projection_center(), image.cam_from_world().rotation.matrix()
        assert np.linalg.norm((center - middle)[:2]) < 12
        assert center[2] > 6.9
        assert turn[1][2] < -0.5
        to_middle = (middle - center) / np.linalg.norm(middle - center)
        assert turn[2] @ to_middle > 0.9


def test_no_camera_stands_in_anything() -> None:
    site = Site.plan(4, "grid", 0)
    caster = Caster(Soup.cat([build_court(site, court, MaterialTable()) for court in range(4)]))
    starts = np.float32([c.center for court in range(4) for c in court_cameras(site, court, 12)])
    for direction in np.float32([[0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]):
        hits = caster.first_hit(starts, np.broadcast_to(direction, starts.shape))
        assert hits.distance.min() > 0.4


def test_every_part_of_the_list_of_cameras_looks_from_all_around() -> None:
    site = Site.plan(1, "grid", 0)
    cameras = court_cameras(site, 0, 56)
    for part in (cameras[::8], cameras[:7], cameras[-7:]):
        angles = np.sort([np.arctan2(c.center[1], c.center[0]) for c in part])
        assert np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.radians(100)


def test_neighbouring_courts_see_each_other(model: pycolmap.Reconstruction) -> None:
    """Points inside one court, observed from the other and from its own cameras."""
    site = Site.plan(2, "grid", 0)
    shared = 0
    for point in model.points3D.values():
        courts = {int(model.images[e.image_id].name[5:8]) for e in point.track.elements}
        inside = min(np.abs(point.xyz - site.center(k))[:2].max() for k in range(2)) < INNER
        shared += inside and len(courts) == 2
    assert shared >= 10


def test_pictures_are_of_things_and_not_noise(scene: Path) -> None:
    """White noise of the same variance has a squared difference between neighbours of twice its variance."""
    for path in (scene / "images").iterdir():
        grey = picture(scene, path.name).mean(axis=2)
        assert 20 < grey.mean() < 235
        assert grey.std() > 10
        steps = np.mean(np.diff(grey, axis=0) ** 2) + np.mean(np.diff(grey, axis=1) ** 2)
        assert steps / 2 < 0.5 * 2 * grey.var()


def test_more_rays_per_pixel_converge() -> None:
    site, lens = Site.plan(1, "grid", 0), Lens(48, 36)
    world = World(site)
    camera = court_cameras(site, 0, 4)[0]
    one, two, six = (render(world, camera, lens, n).astype(np.float64) for n in (1, 2, 6))
    error_one, error_two = (np.square(picture - six).mean() for picture in (one, two))
    assert 0 < error_two < 0.6 * error_one


def test_finished_scene_is_left_alone(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {p: p.stat().st_mtime_ns for p in scene.rglob("*")}
    synth(scene, Settings(**TINY))
    assert "already holds this scene" in capsys.readouterr().err
    assert {p: p.stat().st_mtime_ns for p in scene.rglob("*")} == before


def test_foreign_folder_is_refused_even_with_overwrite(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "holiday.jpg").write_bytes(b"dear")
    for overwrite in (False, True):
        with pytest.raises(UserError, match="not empty"):
            synth(tmp_path, Settings(**TINY), overwrite)
    assert contents(tmp_path) == {"images/holiday.jpg": b"dear"}


def test_other_scene_is_replaced_only_on_request(tmp_path: Path) -> None:
    small = {**TINY, "courts": 1, "views_per_court": 3, "points_per_court": 40, "supersample": 1}
    synth(tmp_path, Settings(**small))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="--overwrite"):
        synth(tmp_path, Settings(**{**small, "views_per_court": 2}))
    synth(tmp_path, Settings(**{**small, "views_per_court": 2}), True)
    assert len(list((tmp_path / "images").iterdir())) == 2
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_interrupted_scene_is_not_taken_for_a_finished_one(tmp_path: Path) -> None:
    small = {**TINY, "courts": 1, "views_per_court": 3, "points_per_court": 40, "supersample": 1}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "abcd_ns.lab.synth.command.write_model", lambda *_: (_ for _ in ()).throw(OSError("full"))
        )
        with pytest.raises(OSError, match="full"):
            synth(tmp_path, Settings(**small))
    with pytest.raises(UserError, match="unfinished"):
        synth(tmp_path, Settings(**small))
    synth(tmp_path, Settings(**small), overwrite=True)
    assert pycolmap.Reconstruction(str(tmp_path / "sparse" / "0")).num_images() == 3


@pytest.mark.parametrize(
    ("name", "value"), [("courts", 0), ("width", 4), ("supersample", 0), ("views_per_court", 1), ("seed", -1)]
)
def test_settings_out_of_range_name_their_flag(tmp_path: Path, name: str, value: int) -> None:
    with pytest.raises(UserError, match=f"--{name.replace('_', '-')} is {value}") as caught:
        synth(tmp_path / "out", Settings(**{**TINY, name: value}))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("courts", "grid", "row"), [(1, (1, 1), (1, 1)), (5, (3, 2), (5, 1)), (64, (8, 8), (64, 1))]
)
def test_layouts(courts: int, grid: tuple[int, int], row: tuple[int, int]) -> None:
    for layout, shape in (("grid", grid), ("row", row)):
        site = Site.plan(courts, layout, seed=0)
        assert len(set(site.cells)) == courts
        assert tuple(np.max(site.cells, axis=0) + 1) == shape


def test_both_sides_of_a_wall_have_the_same_openings() -> None:
    """The halves of a shared wall are built apart; in world coordinates their holes must coincide."""
    site = Site.plan(9, "grid", seed=4)
    for court in range(9):
        for side, sign in ((3, -1), (0, 1)):
            if not site.shares_wall(court, side):
                continue
            other = court + (1 if side == 3 else 3)
            mine = sorted(sign * o.center for o in site.openings(court, side))
            theirs = sorted(-sign * o.center for o in site.openings(other, (side + 2) % 4))
            assert mine == pytest.approx(theirs, abs=1e-12)


def test_gates_can_be_walked_through() -> None:
    """A straight line through the middle of each shared gate meets nothing until the far court."""
    site = Site.plan(2, "row", seed=2)
    world = World(site)
    gate = next(o for o in site.openings(0, 3) if o.sill == 0)
    start = np.array([[-1.2, -gate.center, 1.2]], np.float32)
    assert not world.caster.blocked(start, np.float32([[1, 0, 0]]), np.float32([2.4]))[0]
    high = start + np.float32([0, 0, 1.75])
    assert world.caster.blocked(high, np.float32([[1, 0, 0]]), np.float32([2.4]))[0]


def test_courts_differ_and_stay_within_their_cells() -> None:
    site = Site.plan(3, "row", seed=0)
    courts = [build_court(site, k, MaterialTable()) for k in range(3)]
    for k, court in enumerate(courts):
        offset = np.abs(court.corners - site.center(k).astype(np.float32))[..., :2]
        assert offset.max() <= 6.0 + 1e-4
        assert len(court) < 12_000
    assert len({len(court) for court in courts}) > 1


def test_solids_are_closed_and_their_normals_point_out() -> None:
    """A ray from inside a solid is always blocked; normals lean away from the middle."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for solid in (
        box((-1, -1, -1), (1, 1, 1), 0).placed((3, 0, 0), yaw=0.5),
        lathe([(0, -1), (1, -1), (1, 1), (0, 1)], 0, segments=9).placed((3, 0, 0)),
    ):
        origins = np.broadcast_to(np.float32([3, 0, 0]), directions.shape)
        assert Caster(solid).blocked(origins, directions.astype(np.float32)).all()
        outward = np.einsum("tci,tci->tc", solid.corners - np.float32([3, 0, 0]), solid.normals)
        assert (outward > 0).all()
        assert np.linalg.norm(solid.normals, axis=-1) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_textures_fade_where_they_cannot_be_resolved(kind: str) -> None:
    """Seen with a large footprint, every texture is smoother than close up, and about as bright."""
    table = MaterialTable()
    row = table.add(Material(kind, (0.5, 0.4, 0.3), (0.2, 0.2, 0.2), (0.6, 0.5, 0.4), (0.3, 0.2), 5.0))
    rng = np.random.default_rng(1)
    position = rng.uniform(0, 6, (4000, 3)).astype(np.float32)
    rows = np.full(4000, row)
    fine, coarse = (
        table.albedo(rows, position[:, :2], position, np.full(4000, f, np.float32)) for f in (0.001, 1.0)
    )
    assert fine.min() >= 0.01
    assert fine.max() <= 0.95
    assert coarse.std() <= fine.std() + 1e-6
    assert coarse.mean() == pytest.approx(fine.mean(), rel=0.35)


def test_projection_is_the_inverse_of_the_lens() -> None:
    lens = Lens(48, 36)
    at = np.array([1.0, -2.0, 1.5])
    camera = Camera("a.png", 0, at, look_at(at, np.array([0.0, 3.0, 1.0])))
    assert camera.rotation @ camera.rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(camera.rotation) == pytest.approx(1)
    xy = np.random.default_rng(0).uniform(0, 36, (20, 2))
    depth = np.linspace(0.5, 40, 20)
    world = camera.center + np.einsum("ij,ni->nj", camera.rotation, lens.directions(xy) * depth[:, None])
    back, z = camera.project(world, lens)
    assert back == pytest.approx(xy, abs=1e-9)
    assert z == pytest.approx(depth)


def test_tone_map_keeps_order_and_range() -> None:
    light = np.linspace(0, 20, 1000, dtype=np.float32)
    shown = tone_map(light)
    assert shown[0] == 0
    assert (np.diff(shown) >= 0).all()
    assert shown.max() <= 1
