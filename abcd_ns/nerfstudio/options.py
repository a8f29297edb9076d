"""Which options of a run go together, and which of splatfacto's count."""

import dataclasses

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig

from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.workers import check_workers

MIRRORED = {"sh_degree", "ssim_lambda", "rasterize_mode", "background_color"}
"""Splatfacto's model options that nerfstudio's tools read; `mirror` sets them."""
HONOURED = {"random_init", "num_random", "random_scale", "loss_coefficients", "prompt", "enable_collider"}
"""Those that ABCD obeys as they are."""


def check_options(config: TrainerConfig) -> None:
    """Look at a run's options, before its data is.

    Raises:
        UserError: one is out of range, two contradict each other, or ABCD cannot do what is asked for.
    """
    pipeline = config.pipeline
    if config.machine.num_devices * config.machine.num_machines > 1:
        raise UserError("For several devices give --pipeline.workers; leave out --machine.num-devices.")
    for name in ("blocks", "device_budget_gb", "near_plane", "ram_budget_gb"):
        if not getattr(pipeline, name) >= 0:
            flag = name.replace("_", "-")
            raise UserError(f"--pipeline.{flag} must be 0 or more, not {getattr(pipeline, name)}.")
    if config.is_viewer_legacy_enabled():
        raise UserError("--vis viewer_legacy cannot be guarded against strangers: use --vis viewer.")
    pipeline.training.check()
    check_workers(pipeline.workers, pipeline.cluster, pipeline.blocks, pipeline.training.recipe)
    if config.mixed_precision:
        raise UserError("ABCD trains in float32; leave out --mixed-precision.")
    mirror(pipeline.training, pipeline.model)


def mirror(training: TrainingConfig, model: SplatfactoModelConfig) -> None:
    """Take over what nerfstudio's tools read from the model's options.

    Raises:
        UserError: an option of splatfacto was set that ABCD does not use.
    """
    for option in dataclasses.fields(SplatfactoModelConfig):
        if option.name.startswith("_") or option.name in HONOURED | MIRRORED:
            continue
        default = option.default_factory() if callable(option.default_factory) else option.default
        if getattr(model, option.name) != default:
            flag = option.name.replace("_", "-")
            raise UserError(
                f"--pipeline.model.{flag} is splatfacto's and has no effect here; see the options under "
                "--pipeline.training in `ns-train abcd --help`."
            )
    mirrored = {
        "sh_degree": ("sh_degree", training.sh_degree),
        "ssim_lambda": ("ssim_lambda", training.ssim_lambda),
        "rasterize_mode": ("antialiased", "antialiased" if training.antialiased else "classic"),
        "background_color": ("background", training.background),
        "ownership": ("recipe.ownership", training.recipe.ownership),
    }
    for name, (source, value) in mirrored.items():
        if getattr(model, name) not in (value, getattr(type(model)(), name)):
            flags = (f"--pipeline.model.{name}".replace("_", "-"), source.replace("_", "-"))
            raise UserError(f"{flags[0]} has no effect here; set --pipeline.training.{flags[1]} instead.")
        setattr(model, name, value)
