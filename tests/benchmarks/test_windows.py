"""Windows of two sides are compared on a run of a few steps."""

import json

from benchmarks import windows
from benchmarks.visit import Capture
from benchmarks.windows import Args, main
from tests.reference.scenes import Photos, random_gaussians, ring_of_views


def test_a_pair_of_runs_is_made_for_each_seed(tmp_path, capsys, monkeypatch):
    views, truth = ring_of_views(6), random_gaussians(60, seed=1, sh_degree=3)
    photos, out = Photos(truth, views), tmp_path / "out.json"
    start = random_gaussians(60, seed=2, sh_degree=3)
    monkeypatch.setattr(windows, "read", lambda *_: Capture(views[:4], photos, views[4:], photos, start))
    main(Args(data=tmp_path / "scene", blocks=2, steps=24, seeds=(0,), out=out))
    found = json.loads(out.read_text())
    assert [(row["side"], row["seed"]) for row in found["runs"]] == [(4, 0), (16, 0)]
    for row in found["runs"]:
        assert row["steps"] == 24
        assert 0 < row["frozen_share"] < 1
        assert row["gap"] > row["psnr"] > 5
        assert row["ms_per_view"] > 0
    assert found["data"] == "scene"
    assert sum(line.startswith(("| 4 |", "| 16 |")) for line in capsys.readouterr().out.splitlines()) == 2
