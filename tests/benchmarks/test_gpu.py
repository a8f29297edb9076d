"""`python -m benchmarks.gpu` as far as it goes without a GPU: what is kept of a part, charts."""

from dataclasses import asdict

import pytest
from rich.console import Console

from abcd_ns.lab.results.records import read_json, write_json
from benchmarks import gpu
from benchmarks.gpu import Args, main, show
from tests.lab.compare.records import made_up, made_up_arm
from tests.reference.colmap_scene import write_scene

GIB = 2**30
FOUND = {"hardware": {"gpu": "made up"}}
WHOLE = {"part": "build", "dry_run": True, "error": None, "seconds": 1.0, "found": FOUND}


def test_what_a_part_had_found_is_kept_if_it_breaks_off(tmp_path, monkeypatch):
    def breaks(_args, _work):
        yield FOUND
        raise KeyboardInterrupt

    monkeypatch.setitem(gpu.PARTS, "build", breaks)
    with pytest.raises(KeyboardInterrupt):
        main(Args(out=tmp_path, parts=("build",), dry_run=True))
    record = read_json(tmp_path / "build.json")
    assert (record["error"], record["found"]) == ("unfinished", FOUND)


def test_a_part_that_is_there_is_not_run_again_unless_it_failed(tmp_path, monkeypatch, capsys):
    ran = []

    def note(_args, _work):
        ran.append("build")
        yield FOUND

    monkeypatch.setitem(gpu.PARTS, "build", note)
    args = {"out": tmp_path, "dry_run": True, "parts": ("build",)}
    for kept in (WHOLE | {"error": "unfinished"}, WHOLE | {"dry_run": False}):
        write_json(tmp_path / "build.json", kept)
        ran.clear()
        assert main(Args(**args)) == 0
        assert ran == ["build"]
    assert main(Args(**args)) == 0
    assert ran == ["build"]
    assert "is there; --again" in capsys.readouterr().out
    assert main(Args(again=True, **args)) == 0
    assert ran == ["build", "build"]


def test_every_record_is_shown(tmp_path, capsys):
    memory = {"peak_device_bytes": 2 * GIB, "peak_reserved_bytes": 3 * GIB, "peak_device_note": None}
    joint = "splatfacto", "abcd-monolithic"
    arms = [made_up_arm("default", {0: 20.0 + k}, method, **memory) for k, method in enumerate(joint)]
    arms += [made_up_arm(f"blocks={n}", {0: 22.0 + n}, **memory) for n in (1, 8)]
    found = {"results": asdict(made_up("GPU comparison", *arms))}
    show([WHOLE, WHOLE | {"part": "compare", "found": found}], tmp_path, Console())
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"compare-speed_accuracy.png", "compare-memory.png"}
    assert "splatfacto" in capsys.readouterr().out


@pytest.mark.slow
def test_all_parts_of_a_dry_run_go_through(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(Args(data=write_scene(tmp_path / "scene"), out=out, dry_run=True)) == 0
    checks = read_json(out / "build.json")["found"]
    assert checks["self_check"] < 1e-3
    assert checks["self_check_2dgs"] < 1e-3
    for part in ("compare", "compare-steps"):
        found = read_json(out / f"{part}.json")["found"]["results"]
        arms = [(arm["method"], arm["variant"]) for arm in found["arms"]]
        assert arms == [("splatfacto", "default"), ("abcd", "blocks=2")]
        assert not list((out / "work" / part).rglob("nerfstudio_models"))
    assert read_json(out / "visit.json")["found"]["by_blocks"][0]["profile"]
    assert len(read_json(out / "extent.json")["found"]["results"]["arms"]) == 2
    assert "a dry run: these numbers mean nothing" in capsys.readouterr().out
