"""`python -m benchmarks.large`: a town is made, visited, and what that took is counted."""

from abcd_ns.engine.layers.layer_renderer import LayerRenderer
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.train import visit_training
from abcd_ns.engine.train.step import layer_source
from benchmarks import large


def test_a_visit_is_counted(tmp_path, monkeypatch):
    methods = (ParameterStore, "load"), (LayerRenderer, "load"), (TorchRasterizer, "cuts")
    for owner, name in (*methods, (visit_training, "layers_of_visit"), (layer_source, "PARTS_BYTES")):
        monkeypatch.setattr(owner, name, getattr(owner, name))  # is as it was afterwards
    args = large.Args(gaussians=40, views=4, visits=1, width=48)
    large.make(4, args, tmp_path / "store")
    found = large.measure(4, args, tmp_path / "store")
    assert all(found[name] > 0 for name in ("nodes loaded", "nodes drawn", "steps", "MB peak", "MB disk"))
    assert 0 < found["share of layers"] < 1
