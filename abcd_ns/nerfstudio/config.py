"""What a user sets: the trainer's, pipeline's, datamanager's and model's options."""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import tyro
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE

from abcd_ns.data.input_errors import exit_on_user_error
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.datamanager import AbcdDataManager
from abcd_ns.nerfstudio.dataparser import AbcdDataParser, AbcdDataParserConfig
from abcd_ns.nerfstudio.model import AbcdModel
from abcd_ns.nerfstudio.pipeline import AbcdPipeline
from abcd_ns.nerfstudio.room import Demand, device_budget, find_room
from abcd_ns.nerfstudio.trainer import AbcdTrainer
from abcd_ns.viewer.rules import THIS_MACHINE, WILDCARDS

MIRRORED = {"sh_degree", "ssim_lambda", "rasterize_mode", "background_color"}
"""Splatfacto's model options that nerfstudio's tools read; `AbcdModelConfig.mirror` sets them."""
HONOURED = {"random_init", "num_random", "random_scale", "loss_coefficients", "prompt", "enable_collider"}
"""Those that ABCD obeys as they are."""
# What makes a method and what memory decides stand in config.yml, and are no flags of `ns-train`.
for _not_offered in (Recipe, Limits):
    tyro.conf.configure(tyro.conf.Fixed)(_not_offered)


@dataclass
class AbcdDataManagerConfig(FullImageDatamanagerConfig):
    """Photos, served by crop to the block in training."""

    _target: type = field(default_factory=lambda: AbcdDataManager)
    dataparser: AbcdDataParserConfig = field(default_factory=AbcdDataParserConfig)
    """Where photos, poses and points come from: a COLMAP folder or a transforms.json."""
    photo_cache_gb: float = 0.0
    """RAM for decoded photos, GB; 0 takes the photos' share of `pipeline.ram_budget_gb`."""


@dataclass
class AbcdModelConfig(SplatfactoModelConfig):
    """Splatfacto's model, so that its tools work. How it is trained is set under `pipeline.training`."""

    _target: type = field(default_factory=lambda: AbcdModel)
    rasterizer: Literal["auto", "torch", "gsplat"] = "auto"
    """What draws: gsplat's CUDA kernels or the torch rasterizer; auto takes gsplat on CUDA devices."""
    render: Literal["merged", "composited"] = "merged"
    """How whole pictures are drawn: all Gaussians at once, as any viewer will, or block by block."""

    ownership: tyro.conf.Fixed[Literal["fragments", "means"]] = "fragments"
    """What a layer holds in composited pictures; taken over from the method's recipe."""

    def mirror(self, training: TrainingConfig) -> None:
        """Take over what nerfstudio's tools read from the model's options.

        Raises:
            UserError: an option of splatfacto was set that ABCD does not use.
        """
        for option in dataclasses.fields(SplatfactoModelConfig):
            if option.name.startswith("_") or option.name in HONOURED | MIRRORED:
                continue
            default = option.default_factory() if callable(option.default_factory) else option.default
            if getattr(self, option.name) != default:
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
            if getattr(self, name) not in (value, getattr(type(self)(), name)):
                flags = (f"--pipeline.model.{name}".replace("_", "-"), source.replace("_", "-"))
                raise UserError(f"{flags[0]} has no effect here; set --pipeline.training.{flags[1]} instead.")
            setattr(self, name, value)


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam as 3DGS uses it, one pass over memory for each parameter."""

    fused: bool = True
    """Update a parameter and its moments in one kernel."""


@dataclass
class AbcdPipelineConfig(VanillaPipelineConfig):
    """ABCD: how space is cut and how its blocks are trained."""

    _target: type = field(default_factory=lambda: AbcdPipeline)
    datamanager: AbcdDataManagerConfig = field(default_factory=AbcdDataManagerConfig)
    model: AbcdModelConfig = field(default_factory=AbcdModelConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """How blocks are trained."""
    blocks: int = 0
    """Number of blocks that space is cut into; 1 is ordinary 3DGS. 0 takes as few as `device_budget_gb`
    allows, one where the scene fits, and cuts blocks that outgrow it in two."""
    device_budget_gb: float = 0.0
    """Memory of the device that training may take, GB, by which `blocks` 0 is decided; 0 takes 0.9 of what is
    free on a GPU, and a quarter of the machine's RAM on a CPU. Of a GPU's, an eighth is for layers and an
    eighth for photos."""
    partition: Literal["kd", "grid"] = "kd"
    """kd: cells with equally many points. grid: equal cells, as the paper has, at least `blocks` of them."""
    near_plane: float = 0.0
    """Gaussians closer to a camera than this, along its axis, are not drawn; world units. 0 takes half
    the nearest distance at which a photo shows a point."""
    ram_budget_gb: float = 0.0
    """RAM for photos, blocks and layers that could be read or drawn again, GB; no result depends on it.
    0 takes 8, or 40% of the machine's memory where that is less."""
    max_seconds: float | None = None
    """Stop after this many seconds of training; evaluation and saving do not count."""


def at_home(viewer: ViewerConfig, arguments: Sequence[str]) -> ViewerConfig:
    """Options of the viewer, on this machine alone unless the command line names a host.

    ns-viewer replaces a run's viewer section by its own options, whose default is to listen on all networks.
    """
    flags = ("--viewer.websocket-host", "--viewer.websocket_host")
    named = any(argument.partition("=")[0] in flags for argument in arguments)
    if named or viewer.websocket_host not in WILDCARDS:
        return viewer
    return dataclasses.replace(viewer, websocket_host=THIS_MACHINE)


@dataclass
class AbcdTrainerConfig(TrainerConfig):
    """nerfstudio's trainer with ABCD's checkpoints; moves to the CPU where there is no GPU."""

    _target: type = field(default_factory=lambda: AbcdTrainer)

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "viewer" and "viewer" in self.__dict__:
            value = at_home(value, sys.argv)
        super().__setattr__(name, value)

    def print_to_terminal(self) -> None:
        """A few lines instead of nerfstudio's some hundred; all of it is in config.yml."""
        pipeline = self.pipeline
        what = f"{self.method_name} on {pipeline.datamanager.data}"
        seconds = "" if pipeline.max_seconds is None else f", at most {pipeline.max_seconds:g} s"
        blocks = {0: "as few blocks as fit", 1: "1 block"}.get(pipeline.blocks, f"{pipeline.blocks} blocks")
        CONSOLE.print(f"{what}: {blocks}, {self.max_num_iterations:,} steps{seconds}", highlight=False)

    def save_config(self) -> None:
        """Check what can be checked within seconds, then save; the first thing `ns-train` writes."""
        self.check()
        super().save_config()

    def check(self) -> None:
        """Choose the device and look at the options and the data, before anything is written.

        Exits with code 2 and one line for each fault that the user can mend.
        """
        if self.machine.device_type == "cuda" and not torch.cuda.is_available():
            self.machine.device_type = "cpu"
            CONSOLE.print("No CUDA device was found: training on the CPU with the torch rasterizer.")
        with exit_on_user_error():
            if self.machine.num_devices * self.machine.num_machines > 1:
                raise UserError("ABCD trains on one device; leave out --machine.num-devices.")
            if self.pipeline.blocks < 0:
                raise UserError(f"--pipeline.blocks must be 0 or more, not {self.pipeline.blocks}.")
            if not self.pipeline.device_budget_gb >= 0:
                raise UserError(
                    f"--pipeline.device-budget-gb must be 0 or more, not {self.pipeline.device_budget_gb}."
                )
            if not self.pipeline.near_plane >= 0:
                raise UserError(f"--pipeline.near-plane must be 0 or more, not {self.pipeline.near_plane}.")
            if not self.pipeline.ram_budget_gb >= 0:
                raise UserError(
                    f"--pipeline.ram-budget-gb must be 0 or more, not {self.pipeline.ram_budget_gb}."
                )
            if self.is_viewer_legacy_enabled():
                raise UserError("--vis viewer_legacy cannot be guarded against strangers: use --vis viewer.")
            self.pipeline.training.check()
            if self.mixed_precision:
                raise UserError("ABCD trains in float32; leave out --mixed-precision.")
            self.pipeline.model.mirror(self.pipeline.training)
            parser = self.pipeline.datamanager.dataparser
            if self.pipeline.datamanager.data is not None:
                parser = dataclasses.replace(parser, data=self.pipeline.datamanager.data)
            parser = parser.setup()
            parser.check()
            if self.pipeline.blocks == 0:
                self._check_room(parser)

    def _check_room(self, parser: AbcdDataParser) -> None:
        """See that some block fits on the device."""
        pipeline, model = self.pipeline, self.pipeline.model
        demand = Demand(
            parser.largest_image,
            model.num_random if model.random_init else parser.points or model.num_random,
            pipeline.training,
            most=pipeline.training.density.limit,
            factor=parser.factor,
            on_cpu=self.machine.device_type == "cpu",
        )
        find_room(device_budget(pipeline.device_budget_gb, self.machine.device_type), demand)
