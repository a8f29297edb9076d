"""One run is looked at right before its last shedding and right after."""

import json

from benchmarks.last_shedding import Args, main
from tests.reference.colmap_scene import write_scene


def test_what_went_and_what_it_cost_is_written(tmp_path, capsys):
    out = tmp_path / "found" / "out.json"
    main(Args(data=write_scene(tmp_path / "scene"), out=out, steps=12, blocks=2, downscale=1))
    found = json.loads(out.read_text())
    assert found["scene"] == "scene"
    assert found["shed"]["gone"] > 0
    assert found["held_out_before"] != found["held_out_after"]
    assert all(8 < found[when]["psnr_merged"] < 60 for when in ("held_out_before", "held_out_after"))
    assert '"shed"' in capsys.readouterr().out
