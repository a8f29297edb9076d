"""`abcd compare --tiles`: the terrain is what it claims to be; a run is made and read back."""

import shlex

import pytest
import torch

from abcd_ns.engine.types import Crop
from abcd_ns.lab.compare.charts import draw_charts
from abcd_ns.lab.compare.command import Options, compare, terrain_jobs
from abcd_ns.lab.job import TerrainJob, TerrainSettings
from abcd_ns.lab.results.results import TERRAIN, Arm, Failure, Footing, Run
from abcd_ns.lab.results.tables import write_table
from abcd_ns.lab.runs.runner import why_left_out
from abcd_ns.lab.world.land import Land, color_of
from tests.lab.compare.records import made_up, made_up_run, read_results
from tests.lab.in_process import jobs_in_this_process

AS_ONE = "abcd-monolithic"
MIB = 2**20


@pytest.mark.parametrize("tiles", [1, 2, 8, 32])
def test_each_block_of_the_land_is_one_tile(tiles):
    land = Land(tiles, 50)
    tree = land.tree()
    blocks = tree.assign(land.middles).tolist()
    assert sorted(blocks) == list(range(tiles))
    for tile, block in enumerate(blocks):
        means, corner = land.make_tile(tile).means, torch.tensor(land.corner(tile))
        assert bool((tree.assign(means) == block).all())
        assert bool(((means[:, :2] > corner) & (means[:, :2] < corner + 1)).all())


def test_a_photo_shows_the_lands_colour_where_the_ray_meets_it():
    land = Land(4, 10)
    for view in land.cameras()[::5]:
        photo = land.crop(view, view.full)
        to_world = torch.linalg.inv(view.viewmat)
        for u, v in ((3, 5), (80, 60), (150, 110)):
            pixel = torch.tensor([u + 0.5, v + 0.5, 1.0])
            ray = to_world[:3, :3] @ (torch.linalg.inv(view.K) @ pixel)
            x, y, _ = (to_world[:3, 3] - to_world[2, 3] / ray[2] * ray).tolist()
            inside = 0 <= x < 2 and 0 <= y < 2
            expected = color_of(torch.tensor(x), torch.tensor(y)) if inside else torch.zeros(3)
            assert torch.allclose(photo[v, u], expected, atol=1e-3)
        crop = Crop(16, 32, 48, 16)
        assert torch.equal(land.crop(view, crop), photo[crop.slices])


def made_up_land(tiles: int, peak: int, method: str = "abcd", device: int | None = None) -> Arm:
    visit = None if method == AS_ONE else 2.0
    footing = Footing(400 * MIB, 1.0, 1.0, visit, visit)
    fields = {"gaussians": tiles * 1000, "peak_rss_bytes": peak * MIB, "peak_device_bytes": device}
    found = made_up_run(method, memory=footing, psnr_merged=None, curve=(), **fields)
    return Arm(method, f"tiles={tiles}", tiles, (found,))


def test_one_block_is_not_tried_where_it_was_too_large_for_the_gpu(tmp_path, monkeypatch):
    """No GPU here: the processes' ends are made up. Nor is it tried where it would be huge."""
    small, large = terrain_jobs(TerrainSettings(10**6, 1), (4, 8), (AS_ONE,), (0,))
    assert why_left_out(small) is None
    assert "more than 4,000,000 Gaussians" in why_left_out(large)
    tried = []

    def made_up_end(job: TerrainJob, *_) -> Run | Failure:
        tried.append((job.value, job.method))
        if job.method == AS_ONE and job.value > 2:
            reason = "torch.OutOfMemoryError: CUDA out of memory. Tried to allocate 2.00 GiB."
            return Failure(job.method, job.seed, reason, "log.txt")
        return made_up_land(job.value, 500, job.method, device=100).runs[0]

    monkeypatch.setattr("abcd_ns.lab.runs.runner.finish_job", made_up_end)
    both = {"methods": ("abcd", AS_ONE), "tile_gaussians": 10}
    assert compare(Options(out=str(tmp_path), tiles=(2, 4, 8), **both)) == 0
    assert tried == [(2, "abcd"), (2, AS_ONE), (4, "abcd"), (4, AS_ONE), (8, "abcd")]
    found = read_results(tmp_path / "results.json")
    assert (found.failures, len(found.arms)) == ((), 4)
    assert "as one block, 4 tiles ran out of GPU memory." in (tmp_path / "table.md").read_text()


def test_growth_of_memory_is_said_and_drawn(tmp_path, drawn):
    arms = [made_up_land(2, 500), made_up_land(4, 900), made_up_land(8, 520)]
    joint = [made_up_land(2, 450, AS_ONE), made_up_land(8, 900, AS_ONE)]
    results = made_up(TERRAIN, *arms, *joint, settings=None)
    assert results.findings == ("From 2 to 8 blocks of ABCD, peak RAM grows by 4.0%; allowed: 5%.",)
    write_table(results, tmp_path / "table.md")
    text = (tmp_path / "table.md").read_text()
    assert "| visit (s) | 2.0 | 2.0 | 2.0 | - | - |" in text
    assert "PSNR" not in text
    assert "400 MiB" in text
    assert [path.name for path in draw_charts(results, tmp_path)] == ["memory.png"]
    assert {"abcd, RAM", "abcd-monolithic, RAM", "RAM before any scene"} <= set(drawn["memory.png"])
    on_gpu = made_up_land(2, 500, device=100), made_up_land(4, 500, device=150)
    assert "GPU memory by 50.0%" in made_up(TERRAIN, *on_gpu, settings=None).findings[0]
    assert made_up(TERRAIN, arms[0], settings=None).findings == ()


def test_the_command_trains_writes_and_reuses(tmp_path, capsys, monkeypatch):
    jobs_in_this_process(monkeypatch)
    out = tmp_path / "my land; x"
    given = {"tiles": (2, 1), "methods": ("abcd", AS_ONE), "tile_gaussians": 200, "visits": 1}
    assert compare(Options(out=str(out), **given)) == 0
    first = read_results(out / "results.json")
    words = ["abcd", "compare", "--out", "my land; x", "--methods", AS_ONE, "abcd", "--seeds", "0"]
    words += ["--tiles", "2", "1", "--tile-gaussians", "200", "--visits", "1"]
    assert shlex.split(first.command) == words
    sizes = [("abcd", 1), (AS_ONE, 1), ("abcd", 2), (AS_ONE, 2)]
    assert [(arm.method, arm.value) for arm in first.arms] == sizes
    for arm in first.arms:
        (run,) = arm.runs
        assert (run.gaussians, run.blocks) == (200 * arm.value, arm.value if arm.method == "abcd" else 1)
        assert run.peak_rss_bytes >= run.memory.base_rss_bytes > 0
        assert run.store_bytes >= run.gaussians * 3 * 14 * 4  # with moments
        assert run.steps > 0
        assert run.psnr > 10
        assert run.memory.visit_seconds is None or arm.method == "abcd"
    assert compare(Options(out=str(out), **given)) == 0
    assert read_results(out / "results.json").arms == first.arms
    assert not list(out.glob("runs/*/*/store"))
    assert "peak RAM grows by" in capsys.readouterr().out.replace("\n", " ")
