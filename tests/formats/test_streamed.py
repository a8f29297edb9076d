"""Levels of detail, and the folder of streamed SOG that holds them."""

import json
import os
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import abcd_ns
from abcd_ns.cli import export as export_module
from abcd_ns.errors import UserError
from abcd_ns.formats import streamed
from abcd_ns.formats.streamed import MOST_OPAQUE, merged, merged_in_pairs, pairs, write_streamed
from tests.cli.test_export import export, run, scene  # noqa: F401
from tests.reference.scenes import random_gaussians


def covariance(gaussians, row):
    axes = Rotation.from_quat(np.roll(gaussians.quats[row].double().numpy(), -1)).as_matrix()
    return axes @ np.diag(np.exp(2 * gaussians.scales[row].double().numpy())) @ axes.T


def weight(gaussians, row):
    return float(torch.exp(gaussians.scales[row].topk(2).values.sum()) * gaussians.opacities[row].sigmoid())


def test_two_become_one_with_their_moments():
    first, second = (random_gaussians(20, seed, sh_degree=2) for seed in (1, 2))
    first, second = (replace(each, opacities=each.opacities.clamp_max(-2)) for each in (first, second))
    found = merged(first, second)
    for row in range(20):
        of = [weight(each, row) for each in (first, second)]
        share = [each / sum(of) for each in of]
        mean = sum(s * each.means[row].numpy() for s, each in zip(share, (first, second), strict=True))
        spread = 0
        for s, each in zip(share, (first, second), strict=True):
            away = each.means[row].numpy() - mean
            spread = spread + s * (covariance(each, row) + np.outer(away, away))
        assert np.allclose(found.means[row], mean, atol=1e-5)
        assert np.allclose(covariance(found, row), spread, rtol=1e-3, atol=1e-5 * np.abs(spread).max())
        mixed = share[0] * first.features_rest[row] + share[1] * second.features_rest[row]
        assert torch.allclose(found.features_rest[row], mixed, atol=1e-5)
        assert weight(found, row) == pytest.approx(sum(of), rel=1e-3)


def test_two_opaque_ones_in_one_place_become_a_wider_one():
    one = replace(random_gaussians(20, sh_degree=2), opacities=torch.full((20, 1), 9.0))
    found = merged(one, one)
    assert torch.allclose(found.opacities.sigmoid(), torch.tensor(MOST_OPAQUE))
    wider = found.scales.sort(dim=1).values - one.scales.sort(dim=1).values
    assert torch.allclose(wider, torch.tensor(0.0879), atol=1e-3)


def test_pairs_take_each_row_once_and_leave_no_two_that_could_be_merged():
    gaussians = random_gaussians(300, sh_degree=2)
    first, second = pairs(gaussians)
    rows = torch.cat([first, second]).tolist()
    assert len(rows) == len(set(rows))
    assert 150 <= len(merged_in_pairs(gaussians)) <= 180
    alone = [row for row in range(300) if row not in rows]
    near = torch.cdist(gaussians.means, gaussians.means).argsort(dim=1)[:, 1:9].tolist()
    assert all(other not in near[row] for row in alone for other in alone)


def test_few_stay_as_they_are():
    one = random_gaussians(1, sh_degree=2)
    assert torch.equal(merged_in_pairs(one).means, one.means)
    twice = merged_in_pairs(merged_in_pairs(random_gaussians(2, sh_degree=2)))
    assert len(twice) == 1


def wall():
    """A painted wall of small Gaussians, 60 x 60, three units before the camera."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, 60), torch.linspace(-1, 1, 60), indexing="xy")
    count = x.numel()
    paint = torch.stack([torch.sin(3 * x), torch.cos(4 * y), torch.sin(2 * x + 5 * y)], dim=-1)
    return replace(
        random_gaussians(count, sh_degree=0),
        means=torch.stack([x.ravel(), y.ravel(), torch.full((count,), 3.0)], dim=1),
        scales=torch.tensor([0.02, 0.02, 0.002]).log().expand(count, 3),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        features_dc=paint.reshape(count, 3),
        opacities=torch.zeros(count, 1),
    )


def drawn(gaussians):
    K, size = torch.tensor([[[160.0, 0, 64], [0, 160, 64], [0, 0, 1]]]), 128
    looks = (gaussians.scales.exp(), gaussians.opacities[:, 0].sigmoid(), gaussians.features_dc[:, None])
    given = (gaussians.means, gaussians.quats, *looks, torch.eye(4)[None], K, size, size)
    return abcd_ns.rasterization(*given, sh_degree=0)[0][0]


def test_a_coarser_level_looks_alike_and_better_than_a_random_half():
    level = whole = wall()
    picture = drawn(whole)
    for _ in range(2):
        level = merged_in_pairs(level)
        kept = whole[torch.randperm(len(whole), generator=torch.Generator().manual_seed(0))[: len(level)]]
        coarse, random = ((drawn(each) - picture).square().mean() for each in (level, kept))
        assert float(coarse) < 0.05 * float(random)


def boxes(node):
    """Leaves of a tree; each lies in the bounds of what is above it."""
    for child in node.get("children", []):
        for end, sign in (("min", 1), ("max", -1)):
            both = zip(node["bound"][end], child["bound"][end], strict=True)
            assert all(sign * outer <= sign * inner for outer, inner in both)
        yield from boxes(child)
    if "lods" in node:
        yield node


def test_a_folder_is_what_the_format_describes(run, scene, tmp_path, monkeypatch, capsys):  # noqa: F811
    monkeypatch.setattr(streamed, "MOST_SOG", 100)
    assert export(run, out=tmp_path / "garden", lod=True) == 0
    assert "garden (" in capsys.readouterr().out
    meta = json.loads((tmp_path / "garden/lod-meta.json").read_text())
    leaves = list(boxes(meta["tree"]))
    assert len(leaves) > len(scene) / 100
    assert meta["version"] == 1
    assert meta["counts"][0] == len(scene) - 1  # one is never drawn
    assert meta["count"] == sum(meta["counts"])
    totals = [0] * meta["lodLevels"]
    for leaf in leaves:
        for level, part in leaf["lods"].items():
            sog = json.loads((tmp_path / "garden" / meta["filenames"][part["file"]]).read_text())
            assert sog["count"] == part["count"]
            assert part["offset"] == 0
            totals[int(level)] += part["count"]
    assert totals == meta["counts"]
    assert len(meta["filenames"]) == len(leaves) * meta["lodLevels"]


def killed(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_processes_write_the_same_and_one_that_is_killed_ends_it_in_a_line(tmp_path, monkeypatch):
    monkeypatch.setattr(streamed, "MOST_SOG", 100)
    written = []
    for processes in (1, 2):
        (folder := tmp_path / str(processes)).mkdir()
        write_streamed(folder, [random_gaussians(300, sh_degree=1)], processes=processes)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        written.append({path.relative_to(folder): path.read_bytes() for path in files})
    assert written[0] == written[1]
    monkeypatch.setattr(streamed, "_write_leaf", killed)
    with pytest.raises(UserError, match="A process that packs was killed: free memory"):
        write_streamed(tmp_path, [random_gaussians(50)], processes=2)


def test_it_takes_a_new_folder_and_leaves_none_behind(run, tmp_path, monkeypatch):  # noqa: F811
    with pytest.raises(UserError, match="leave out --by-block"):
        export(run, out=tmp_path / "garden", lod=True, by_block=True)
    monkeypatch.setattr(export_module, "MOST_SOG", 200)
    with pytest.raises(UserError, match=r"\.sog of 299 Gaussians .* use --lod, or .compressed.ply"):
        export(run, out=tmp_path / "garden.sog")
    assert not list(tmp_path.glob("garden*"))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(streamed, "packed", full)
    with pytest.raises(OSError, match="No space"):
        export(run, out=tmp_path / "garden", lod=True)
    assert not (tmp_path / "garden").exists()
