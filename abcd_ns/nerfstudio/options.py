"""Which options of a run go together, and which of nerfstudio's count."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig

from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.datamanager import UNUSED as UNUSED_OF_DATA
from abcd_ns.nerfstudio.workers import check_workers

MIRRORED = {"sh_degree", "ssim_lambda", "rasterize_mode", "background_color"}
"""Splatfacto's model options that nerfstudio's tools read; `mirror` sets them."""
HONOURED = {"random_init", "num_random", "random_scale", "rasterize_mode", "color_corrected_metrics"}
"""Splatfacto's model options that are flags of `ns-train abcd` too."""
TOLERATED = {"eval_num_rays_per_chunk"}
"""ns-render sets it for all methods; pictures of Gaussians are not drawn by rays."""
SAME = {
    TrainingConfig: {
        "sh_degree": "sh-degree",
        "ssim_lambda": "ssim-lambda",
        "background": "background-color",
        "poses": "camera-optimizer.mode",
    },
    DensityConfig: {
        "refine_every": "refine-every",
        "cull_alpha_thresh": "cull-alpha-thresh",
        "densify_grad_thresh": "densify-grad-thresh",
        "use_absgrad": "use-absgrad",
    },
}
"""By class and field, the flag of splatfacto's under --pipeline.model that means the same; taken too."""
INSTEAD = {
    "camera_optimizer": "training.poses SO3xR3",
    "warmup_length": "training.density.refine-start, a share of the run",
    "stop_split_at": "training.density.refine-stop, a share of the run",
    "reset_alpha_every": "training.density.reset-every, in steps",
    "refine_every": "training.density.refine-every",
    "cull_alpha_thresh": "training.density.cull-alpha-thresh",
    "densify_grad_thresh": "training.density.densify-grad-thresh",
    "use_absgrad": "training.density.use-absgrad",
}
"""What has the place of an option of splatfacto's."""
UNUSED = {
    "gradient_accumulation_steps": "a step draws as many views as --pipeline.training.batch says",
    "mixed_precision": "ABCD trains in float32",
    "use_grad_scaler": "ABCD trains in float32",
    "load_scheduler": "learning rates follow the progress of the run",
    "prompt": "ABCD trains on photos",
}
"""Options of nerfstudio's trainer that ABCD has no use for, and why."""
HIDDEN = tuple(
    option.name
    for option in dataclasses.fields(SplatfactoModelConfig)
    if option.name not in HONOURED and not option.name.startswith("_")
)
"""Options of splatfacto's model that are no flags of `ns-train abcd`, or under other names."""


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
    refuse_changed(config, UNUSED, "")
    refuse_changed(pipeline.datamanager, UNUSED_OF_DATA, "pipeline.datamanager.")
    for name, group in config.optimizers.items():
        if group["optimizer"].max_norm is not None:
            raise UserError(
                f"--optimizers.{name}.optimizer.max-norm has no effect here: steps whose gradients are no "
                "numbers are skipped, and others are not clipped."
            )
    mirror(pipeline.training, pipeline.model)


def refuse_changed(config: Any, unused: Mapping[str, str], prefix: str) -> None:
    """See that options without effect are at their defaults.

    Args:
        unused: why they have none, by name.
        prefix: of their flags.

    Raises:
        UserError: one is not.
    """
    for name, why in unused.items():
        if getattr(config, name) != _default(type(config), name):
            raise UserError(f"--{prefix}{name.replace('_', '-')} has no effect here: {why}.")


def mirror(training: TrainingConfig, model: SplatfactoModelConfig) -> None:
    """Take over what nerfstudio's tools read from the model's options, and what its user set there.

    Raises:
        UserError: an option of splatfacto was set that ABCD does not use.
    """
    for name in HIDDEN:
        if name in MIRRORED | TOLERATED or getattr(model, name) == _default(type(model), name):
            continue
        flag = f"--pipeline.model.{name.replace('_', '-')}"
        if name in INSTEAD:
            raise UserError(f"{flag} has no effect here; set --pipeline.{INSTEAD[name]}, instead.")
        raise UserError(
            f"{flag} is splatfacto's and has no effect here; see the options under --pipeline.training in "
            "`ns-train abcd --help`."
        )
    if model.rasterize_mode == "antialiased":
        training.antialiased = True
    if training.light != "none":  # held-out photos have a light of their own, too
        model.color_corrected_metrics = True
    mirrored = {
        "sh_degree": ("sh_degree", training.sh_degree),
        "ssim_lambda": ("ssim_lambda", training.ssim_lambda),
        "rasterize_mode": ("antialiased", "antialiased" if training.antialiased else "classic"),
        "background_color": ("background", training.background),
        "ownership": ("recipe.ownership", training.recipe.ownership),
    }
    for name, (source, value) in mirrored.items():
        if getattr(model, name) not in (value, _default(type(model), name)):
            flags = (f"--pipeline.model.{name}".replace("_", "-"), source.replace("_", "-"))
            raise UserError(f"{flags[0]} has no effect here; set --pipeline.training.{flags[1]} instead.")
        setattr(model, name, value)


def _default(config: type, name: str) -> Any:
    (option,) = (option for option in dataclasses.fields(config) if option.name == name)
    return option.default if option.default_factory is dataclasses.MISSING else option.default_factory()
