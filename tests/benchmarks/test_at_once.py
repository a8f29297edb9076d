"""Visits at once are measured on a run of a few steps; what is there already is not made again."""

import json
from dataclasses import replace

import pytest

from abcd_ns.nerfstudio import pipeline
from benchmarks import at_once
from benchmarks.at_once import Args, main
from tests.reference.colmap_scene import write_scene


def test_runs_are_made_once_and_told_in_a_table(tmp_path, capsys, monkeypatch):
    # Another process would import torch.
    monkeypatch.setattr(at_once, "apart", lambda work, *args: work(*args))
    monkeypatch.setattr(pipeline, "dispatcher_for", pipeline.dispatcher_for)  # to be put back
    out = tmp_path / "out.json"
    args = Args(
        data=write_scene(tmp_path / "scene"),
        downscale=1,
        visits=(2,),
        blocks=4,
        steps=16,
        seeds=(0,),
        out=out,
    )
    main(args)
    (row,) = json.loads(out.read_text())["runs"]
    assert (row["at_once"], row["most_out"], row["steps"]) == (2, 2, 16)
    assert row["visits"] > 2
    assert row["psnr"] > 5
    capsys.readouterr()
    main(args)
    assert json.loads(out.read_text())["runs"] == [row]
    table = capsys.readouterr().out.splitlines()
    with pytest.raises(SystemExit, match="another question"):
        main(replace(args, steps=20))
    assert table[-1] == f"| 2 | {row['psnr']:.2f} | {row['psnr']:.2f} |"
