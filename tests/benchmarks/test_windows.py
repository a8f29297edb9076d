"""Windows of two sides are compared on a run of a few steps."""

import json

from abcd_ns.lab.stability.lab import make_stage
from abcd_ns.lab.world.world import ring
from benchmarks import windows
from benchmarks.windows import Args, main


def test_a_pair_of_runs_is_made_for_each_seed(tmp_path, capsys, monkeypatch):
    stage, out = make_stage(views=ring(4), held_out=ring(2, turn=0.3), points=60), tmp_path / "out.json"
    monkeypatch.setattr(windows, "read_stage", lambda *_: stage)
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
