"""What `abcd compare` makes of splatfacto."""

from dataclasses import replace

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import SceneBox

from abcd_ns.lab.runs.splatfacto import Splatfacto, scaled

BOX = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))


@pytest.mark.skipif(torch.cuda.is_available(), reason="it then draws by gsplat itself")
def test_it_trains_grows_and_draws_on_a_cpu_and_fetches_no_weights(monkeypatch):
    from nerfstudio.configs.method_configs import method_configs

    def fetch(*_args, **_options):
        raise AssertionError("asked the network")

    monkeypatch.setattr("torch.hub.download_url_to_file", fetch)
    monkeypatch.setattr("torch.hub.load_state_dict_from_url", fetch)
    torch.manual_seed(0)
    config = scaled(method_configs["splatfacto"], 1500).pipeline.model
    config = replace(config, num_downscales=0, cull_alpha_thresh=0.005, background_color="black")
    points = 0.3 * torch.randn(200, 3), 255 * torch.rand(200, 3)
    model = Splatfacto(config, scene_box=BOX, num_train_data=1, seed_points=points)
    away = torch.eye(4)[None, :3]
    away[0, 2, 3] = 3.0
    camera = Cameras(away, 50.0, 50.0, 24.0, 16.0, 48, 32, camera_type=CameraType.PERSPECTIVE)
    photo = torch.tensor([0.7, 0.3, 0.2]).expand(32, 48, 3)
    adams = {n: torch.optim.Adam(p, lr=0.01) for n, p in model.get_gaussian_param_groups().items()}
    optimizers, losses = type("Optimizers", (), {"optimizers": adams}), []
    model.train()
    for step in range(60):
        model.step_cb(optimizers, step)
        loss = sum(model.get_loss_dict(model.get_outputs(camera), {"image": photo}).values())
        for adam in adams.values():
            adam.zero_grad()
        loss.backward()
        for adam in adams.values():
            adam.step()
        model.step_post_backward(step)
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.7 * losses[1]
    assert model.num_points > 200
    model.eval()
    picture = model.get_outputs_for_camera(camera)["rgb"]
    assert picture.shape == (32, 48, 3)


def test_all_its_schedules_are_scaled_together():
    from nerfstudio.configs.method_configs import method_configs

    shipped = method_configs["splatfacto"]
    found = scaled(shipped, 3000)
    model = found.pipeline.model
    assert (model.warmup_length, model.refine_every, model.stop_split_at) == (50, 10, 1500)
    assert (model.resolution_schedule, model.sh_degree_interval, model.reset_alpha_every) == (300, 100, 30)
    assert found.optimizers["means"]["scheduler"].max_steps == 3000
    assert found.optimizers["camera_opt"]["scheduler"].warmup_steps == 100
    assert shipped.pipeline.model.refine_every == 100
