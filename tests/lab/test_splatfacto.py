"""What `abcd compare` makes of splatfacto."""

from dataclasses import replace

import torch
from nerfstudio.data.scene_box import SceneBox

from abcd_ns.lab.runs.splatfacto import Splatfacto


def test_it_is_made_without_fetching_weights(monkeypatch):
    from nerfstudio.configs.method_configs import method_configs

    def fetch(*_args, **_options):
        raise AssertionError("asked the network")

    monkeypatch.setattr("torch.hub.download_url_to_file", fetch)
    monkeypatch.setattr("torch.hub.load_state_dict_from_url", fetch)
    model = Splatfacto(
        replace(method_configs["splatfacto"].pipeline.model, random_init=True, num_random=50),
        scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])),
        num_train_data=3,
    )
    assert model.num_points == 50
