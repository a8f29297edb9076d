"""Runs of either kind are scored at every size."""

import json
from pathlib import Path

from benchmarks import zoom
from benchmarks.visit import Capture
from benchmarks.zoom import Args, main
from tests.reference.scenes import Photos, random_gaussians, ring_of_views


def test_runs_of_either_kind_are_scored_at_every_size(tmp_path, capsys, monkeypatch):
    truth, start = (random_gaussians(60, seed=seed, sh_degree=3) for seed in (1, 2))

    def read(_: Path, downscale: int) -> Capture:
        views = ring_of_views(6, width=96 // downscale, height=72 // downscale)
        photos = Photos(truth, views)
        return Capture(views[:4], photos, views[4:], photos, start)

    monkeypatch.setattr(zoom, "read", read)
    out = tmp_path / "out.json"
    main(Args(data=tmp_path / "scene", downscale=2, drawn=(4, 2), blocks=2, steps=16, out=out))
    found = json.loads(out.read_text())
    assert [(row["antialiased"], row["seed"]) for row in found["runs"]] == [(False, 0), (True, 0)]
    for row in found["runs"]:
        assert set(row["psnr"]) == {"4", "2"}
        assert all(psnr > 5 for psnr in row["psnr"].values())
    plain, antialiased = (row["psnr"] for row in found["runs"])
    assert plain != antialiased
    assert found["data"] == "scene"
    assert sum(line.startswith(("| yes", "| no")) for line in capsys.readouterr().out.splitlines()) == 2
