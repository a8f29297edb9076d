"""Which options of a run go together, and which of nerfstudio's count."""

import dataclasses
import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from itertools import takewhile
from operator import attrgetter
from typing import Any

import tyro
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig

from abcd_ns.engine.train.config import TrainingConfig, check_not_below_0
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.engine.train.schedule import DECAY_VIEWS
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.datamanager import READERS
from abcd_ns.nerfstudio.datamanager import UNUSED as UNUSED_OF_DATA
from abcd_ns.nerfstudio.flags import UNUSED_OF_MACHINE, UNUSED_OF_VIEWER, annotated, hidden, shown
from abcd_ns.nerfstudio.run.settings import flat_options
from abcd_ns.nerfstudio.workers import check_workers

MIRRORED = {
    "sh_degree": "sh_degree",
    "ssim_lambda": "ssim_lambda",
    "rasterize_mode": "antialiased",
    "background_color": "background",
    "ownership": "recipe.ownership",
    "primitive": "primitive",
}
"""The model's options that nerfstudio's tools and viewers read, and those of `training` that set them."""
HONOURED = {"random_init", "num_random", "random_scale", "rasterize_mode", "color_corrected_metrics"}
"""Splatfacto's model options that are flags of `ns-train abcd` too."""
SAME = {
    TrainingConfig: {
        "sh_degree": "sh-degree",
        "ssim_lambda": "ssim-lambda",
        "background": "background-color",
        "poses": "camera-optimizer.mode",
    },
    DensityConfig: {"refine_every": "refine-every", "cull_alpha_thresh": "cull-alpha-thresh"},
}
"""By class and field, the flag under --pipeline.model that splatfacto has for it; accepted too."""
# What makes a method and what memory decides are in config.yml, but no options.
for _not_offered in (Recipe, Limits):
    tyro.conf.configure(tyro.conf.Fixed)(_not_offered)
_first = ("primitive", "sh_degree", "background", "light", "poses", "antialiased", "warmup", "density")
shown(*_first)(hidden("seed")(TrainingConfig))
shown("strategy", "max_gaussians", "min_contribution", "split_pixels")(DensityConfig)
for _config, _flags in SAME.items():
    _marks = {name: tyro.conf.arg(aliases=[f"--pipeline.model.{flag}"]) for name, flag in _flags.items()}
    annotated(_config, _marks)

_SPLITS = "each that grows becomes two, large or small"
_ERROR = "set --pipeline.training.density.split-pixels instead: Gaussians grow by error, not by gradients"
_REDUCED = "set --pipeline.training.coarse, a share of the run, instead"
_OVERSIZED = "oversized Gaussians are shrunk, by their size as the nearest camera sees it"
_GRIDS = "set --pipeline.training.light affine instead, which measured as good"
_RAYS = "it is about rays, and Gaussians are not drawn by rays"
UNUSED_OF_MODEL = {
    "warmup_length": "set --pipeline.training.density.refine-start, a share of the run, instead",
    "stop_split_at": "set --pipeline.training.density.refine-stop, a share of the run, instead",
    "reset_alpha_every": "opacities are not reset: pruning is by contribution",
    **{name: f"set --pipeline.training.density.{flag} instead" for name, flag in SAME[DensityConfig].items()},
    **dict.fromkeys(("densify_size_thresh", "n_split_samples"), _SPLITS),
    **dict.fromkeys(("densify_grad_thresh", "use_absgrad"), _ERROR),
    "sh_degree_interval": "the degree rises over a tenth of the run, whatever its length",
    **dict.fromkeys(("num_downscales", "resolution_schedule"), _REDUCED),
    **dict.fromkeys(("cull_screen_size", "stop_screen_size_at"), _OVERSIZED),
    "split_screen_size": "nothing is split for its size",
    **dict.fromkeys(("cull_scale_thresh", "use_scale_regularization", "max_gauss_ratio"), _OVERSIZED),
    **dict.fromkeys(("use_bilateral_grid", "grid_shape"), _GRIDS),
    "camera_optimizer": "set --pipeline.training.poses SO3xR3 instead",
    "output_depth_during_training": "no loss here needs depth; trained scenes have it",
    **dict.fromkeys(("enable_collider", "collider_params", "eval_num_rays_per_chunk"), _RAYS),
    "loss_coefficients": "set --pipeline.training.ssim-lambda instead",
    "prompt": "ABCD trains on photos",
}
"""Options of splatfacto's model that ABCD has no use for, and why."""
UNUSED = {
    "gradient_accumulation_steps": "a step draws as many views as --pipeline.training.batch says",
    **dict.fromkeys(("mixed_precision", "use_grad_scaler"), "ABCD trains in float32"),
    "load_scheduler": "learning rates follow the progress of the run",
    "prompt": "ABCD trains on photos",
}
"""Options of nerfstudio's trainer that ABCD has no use for, and why."""
NOT_CLIPPED = "steps whose gradients are no numbers are skipped, and others are not clipped"
UNUSED_OF_OPTIMIZERS = {
    "camera_opt": "poses are refined by steps of their own, see --pipeline.training.poses",
    "bilateral_grid": _GRIDS,
    "*.scheduler": "rates follow the run",
    "*.optimizer.max_norm": NOT_CLIPPED,
    "*.optimizer.fused": "a parameter and its moments are updated by one kernel in any case",
}
"""Options of splatfacto's optimizers that ABCD has no use for, and why."""
SEED = "set --machine.seed instead"
NO_FLAGS = {
    **UNUSED,
    **{f"machine.{name}": why for name, why in UNUSED_OF_MACHINE.items()},
    **{f"pipeline.model.{name}": why for name, why in UNUSED_OF_MODEL.items()},
    **{f"pipeline.datamanager.{name}": why for name, why in UNUSED_OF_DATA.items()},
    **{f"optimizers.{name}": why for name, why in UNUSED_OF_OPTIMIZERS.items()},
    **{f"viewer.{name}": why for name, why in UNUSED_OF_VIEWER.items()},
    "pipeline.training.seed": SEED,
    "pipeline.training.recipe": "choose another method; `abcd compare --vary` can change parts of one",
    "pipeline.training.limits": "they follow from --pipeline.device-budget-gb",
}
"""What are no flags of `ns-train abcd`, by pattern, and why."""
HIDDEN = tuple(
    option.name
    for option in dataclasses.fields(SplatfactoModelConfig)
    if option.name not in HONOURED and not option.name.startswith("_")
)
"""Options of splatfacto's model that have no effect, or are set under other names."""


def check_options(config: TrainerConfig) -> None:
    """Raise a UserError if an option is out of range or has no effect, or two contradict each other."""
    pipeline = config.pipeline
    pipeline.check_ranges()
    check_not_below_0(pipeline, ("model.num_random", "model.random_scale", "datamanager.photo_cache_gb"))
    if config.max_num_iterations < 1:
        raise UserError(f"--max-num-iterations must be 1 or more, not {config.max_num_iterations}.")
    if config.is_viewer_legacy_enabled():
        raise UserError("--vis viewer_legacy cannot be guarded against strangers: use --vis viewer.")
    if pipeline.training.recipe.overlap > 0 and pipeline.blocks == pipeline.gaussian_bytes == 0:
        raise UserError("abcd-partition cuts no block that outgrows the device: give --pipeline.blocks.")
    check_workers(config)
    if pipeline.training.seed not in (TrainingConfig.seed, config.machine.seed):
        raise UserError(_no_effect("pipeline.training.seed", SEED))
    _refuse_changed(config, UNUSED, "")
    _refuse_changed(config.machine, UNUSED_OF_MACHINE, "machine.")
    _refuse_changed(config.viewer, UNUSED_OF_VIEWER, "viewer.")
    _refuse_changed(pipeline.datamanager, UNUSED_OF_DATA, "pipeline.datamanager.")
    for name, group in config.optimizers.items():
        if group["optimizer"].max_norm is not None:
            raise UserError(_no_effect(f"optimizers.{name}.optimizer.max_norm", NOT_CLIPPED))
    mirror(pipeline.training, pipeline.model)


def _refuse_changed(config: Any, unused: Mapping[str, str], prefix: str) -> None:
    """Raise a UserError if an option without effect is not at its default; flags begin with `prefix`."""
    defaults = type(config)()
    for name, why in unused.items():
        if getattr(config, name) != getattr(defaults, name):
            raise UserError(_no_effect(f"{prefix}{name}", why))


def refuse_flags(words: Sequence[str], config: TrainerConfig) -> None:
    """Raise a UserError if one of `ns-train`'s words after the method's name is a flag without effect; names
    the reason, or the nearest option. Words after the name of a reader are its own."""
    same = (name.replace("-", "_") for flags in SAME.values() for name in flags.values())
    taken = {f"pipeline.model.{name}" for name in (*same, *HONOURED)}
    known = {*flat_options(config)} - {f"pipeline.model.{name}" for name in MIRRORED} | taken
    for word in takewhile(lambda word: word not in READERS, words):
        name = word[2:].partition("=")[0].replace("-", "_")
        if not word.startswith("--") or name == "help" or name.startswith("tyro_"):
            continue
        why = next((why for part, why in NO_FLAGS.items() if fnmatchcase(f"{name}.", f"{part}.*")), None)
        if why is not None and name not in taken:
            raise UserError(_no_effect(name, why))
        if name not in known:
            near = " or ".join(f"--{each.replace('_', '-')}" for each in nearest(name, known))
            hint = f"did you mean {near}?" if near else "docs/reference.md lists all."
            raise UserError(f"There is no option --{name.replace('_', '-')}; {hint}")


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """The three names most like `name`, by words of the last part, that part or the whole; splatfacto's come
    last."""
    ends, last = {each: each.rpartition(".")[2] for each in known}, name.rpartition(".")[2]
    alike = sorted({end for end in ends.values() if {*end.split("_")} < {*last.split("_")}})
    alike += difflib.get_close_matches(last, sorted({*ends.values()}), n=3, cutoff=0.8)
    found = [each for end in alike for each in ends if ends[each] == end]
    found += difflib.get_close_matches(name, ends, n=3, cutoff=0.8)
    return sorted(dict.fromkeys(found), key=lambda each: "model." in each)[:3]


def mirror(training: TrainingConfig, model: SplatfactoModelConfig) -> None:
    """Set the model's options that nerfstudio's tools read, and take over what the user set there. A
    UserError if ABCD does not use an option that was set."""
    # ns-render sets this one for all methods.
    unused = {name: why for name, why in UNUSED_OF_MODEL.items() if name != "eval_num_rays_per_chunk"}
    _refuse_changed(model, unused, "pipeline.model.")
    if model.rasterize_mode == "antialiased":
        training.antialiased = True
    if model.init_splats is not None:  # trained already, on whole pictures
        training.warmup = training.coarse = 0.0
        training.recipe = replace(training.recipe, sh_ramp=0.0, trained_before=DECAY_VIEWS)
    if training.light != "none":  # held-out photos have a light of their own, too
        model.color_corrected_metrics = True
    defaults = type(model)()
    for name, source in MIRRORED.items():
        value = attrgetter(source)(training)
        if name == "rasterize_mode":
            value = "antialiased" if value else "classic"
        if getattr(model, name) not in (value, getattr(defaults, name)):
            flag, instead = name.replace("_", "-"), source.replace("_", "-")
            raise UserError(
                f"--pipeline.model.{flag} has no effect here; set --pipeline.training.{instead} instead."
            )
        setattr(model, name, value)


def _no_effect(option: str, why: str) -> str:
    return f"--{option.replace('_', '-')} has no effect here: {why}."
