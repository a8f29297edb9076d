"""What `abcd compare` makes of splatfacto."""

import torch
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.scene_box import SceneBox

from abcd_ns.lab.runs.splatfacto import Splatfacto, scaled


def test_it_fetches_no_weights(monkeypatch):
    """That it trains and draws on a CPU is seen in compare/test_real.py."""
    for name in ("download_url_to_file", "load_state_dict_from_url"):
        monkeypatch.setattr(f"torch.hub.{name}", None)
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    points = torch.randn(200, 3), 255 * torch.rand(200, 3)
    config = method_configs["splatfacto"].pipeline.model
    assert Splatfacto(config, scene_box=box, num_train_data=1, seed_points=points).num_points == 200


def test_all_its_schedules_are_scaled_together():
    shipped = method_configs["splatfacto"]
    found = scaled(shipped, 3000)
    model = found.pipeline.model
    assert (model.warmup_length, model.refine_every, model.stop_split_at) == (50, 10, 1500)
    assert (model.resolution_schedule, model.sh_degree_interval, model.reset_alpha_every) == (300, 100, 30)
    assert found.optimizers["means"]["scheduler"].max_steps == 3000
    assert found.optimizers["camera_opt"]["scheduler"].warmup_steps == 100
    assert shipped.pipeline.model.refine_every == 100
