"""Runs of either kind are scored at every size."""

import json
from pathlib import Path

from abcd_ns.lab.stability.lab import Stage, make_stage
from abcd_ns.lab.world.world import ring
from benchmarks import zoom
from benchmarks.zoom import Args, main


def test_runs_of_either_kind_are_scored_at_every_size(tmp_path, capsys, monkeypatch):
    def read(_: Path, downscale: int) -> Stage:
        size = 96 // downscale, 72 // downscale
        return make_stage(views=ring(4, size=size), held_out=ring(2, turn=0.3, size=size), points=60)

    monkeypatch.setattr(zoom, "read_stage", read)
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
