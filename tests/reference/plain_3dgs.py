"""3DGS as a plain loop over whole pictures: no blocks, no layers, no store. The oracle for one block."""

import random

import torch

from abcd_ns.engine.gaussians.adam import Adam
from abcd_ns.engine.gaussians.param_swap import LEARNING_RATES, rates_of_under_trained
from abcd_ns.engine.render.base import Surroundings
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.render.loss import photometric_loss
from abcd_ns.engine.render.pictures import lacking, pictures_of
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityClock, DensityControl
from abcd_ns.engine.train.density.growing import Judged
from abcd_ns.engine.train.schedule import endless_order, exponential_decay, final_decay, sh_degree_at
from abcd_ns.engine.types import PARAM_NAMES, Gaussians, View
from tests.reference.scenes import Photos


def train_plain(
    gaussians: Gaussians, views: list[View], photos: Photos, *, steps: int, config: TrainingConfig
) -> Gaussians:
    """Train for `steps` on the views in the order that a run of one block takes, and return the result."""
    params = {name: torch.nn.Parameter(value.clone()) for name, value in gaussians.items()}
    adam = {n: Adam([params[n]], lr=LEARNING_RATES[n], eps=1e-15, fused=True) for n in PARAM_NAMES}
    draw, density, growth, refined = TorchRasterizer(), DensityControl(config.density), {}, 0
    for taken in range(steps):
        row = endless_order(tuple(range(len(views))), taken, config.seed)
        view, degree = views[row], sh_degree_at(taken / steps, config.recipe.sh_ramp, config.sh_degree)
        share = final_decay(taken / steps, taken) * rates_of_under_trained(taken, 1)
        for name, rate in LEARNING_RATES.items():
            decay = exponential_decay(taken / steps, config.recipe.means_lr_decay) if name == "means" else 1.0
            adam[name].param_groups[0]["lr"] = rate * decay * share
        active = Gaussians(**{name: params[name] for name in PARAM_NAMES})
        raster = draw(active, view, sh_degree=degree, residual_sums=True)
        seed = random.Random(f"background {config.seed} {taken} 0").getrandbits(62)
        background = torch.rand(3, generator=torch.Generator().manual_seed(seed))
        (picture,) = pictures_of([raster], [Surroundings(None, None, background, 0.0)])
        pixels, windows = view.width * view.height, (view.width - 10) * (view.height - 10)
        loss = photometric_loss(picture, photos.images[row], full_pixels=pixels, full_windows=windows)
        for optimizer in adam.values():
            optimizer.zero_grad()
        residual, error = lacking(picture, photos.images[row], None)
        raster.info["sums"].ask([residual])
        loss.backward()
        for optimizer in adam.values():
            optimizer.step()
        clock = DensityClock((taken + 1) / steps, taken + 1, 1, len(views), None, refined=refined)
        judged = Judged(view, raster.info["sums"].values[0], error)
        judged = [judged] if density.asks(taken / steps, first=False) else []
        growth = density.gather(params, growth, (raster.info,), judged, clock.views)
        growth, refines = density.after_step(params, adam, growth, clock)
        refined = clock.steps if refines else refined
    return Gaussians(**{name: params[name].detach() for name in PARAM_NAMES})
