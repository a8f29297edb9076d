"""Splatfacto's model around the engine: the active block in training, the merged scene for other tools."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.model_components import renderers
from nerfstudio.models.splatfacto import SH2RGB, SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils.colors import get_color
from pytorch_msssim import SSIM
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from abcd_ns.data.dataset import PHOTOS
from abcd_ns.data.input_errors import say
from abcd_ns.engine.gaussians.block_state import checksum
from abcd_ns.engine.gaussians.param_swap import active_gaussians
from abcd_ns.engine.layers.layer_renderer import LayerRenderer, Ownership, RenderSettings, default_pass
from abcd_ns.engine.layers.surface import colored_by_normal, fog_in_white, median_depth, normals_in
from abcd_ns.engine.render import PrimitiveName, Raster, Rasterizer, make_rasterizer
from abcd_ns.engine.render.loss import photometric_loss, psnr, squared_errors, ssim_windows
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store.scene import BlockScene, ChangedScene, MemoryScene, StoredScene
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.memory import free_bytes, frozen_bytes
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.types import NEAR_PLANE, Gaussians, Layer, View
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.datamanager import BATCH
from abcd_ns.nerfstudio.flags import as_a_command, hidden, shown
from abcd_ns.nerfstudio.metrics import image_metrics
from abcd_ns.nerfstudio.options import HIDDEN
from abcd_ns.nerfstudio.outputs import Outputs, as_list, masked, pictured
from abcd_ns.nerfstudio.views import view_of
from abcd_ns.run.fit import FREE_SHARE
from abcd_ns.viewer import pictures as viewed

Values = dict[str, Any]
VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""What splatfacto puts behind whole pictures when it trains on random backgrounds: viser's own colour."""


@shown("rasterizer", "init_splats")
@hidden(*HIDDEN)
@dataclass
class AbcdModelConfig(SplatfactoModelConfig):
    """Splatfacto's model, so that its tools work. How it is trained is set under `pipeline.training`."""

    _target: type = field(default_factory=lambda: AbcdModel)
    rasterizer: Literal["auto", "torch", "gsplat"] = "auto"
    """gsplat: CUDA kernels. torch: any device. auto takes gsplat on CUDA devices."""
    random_init: bool = False
    """Start with Gaussians at random places instead of the points."""
    init_splats: Path | None = None
    """Start with the Gaussians of a .ply file, in the frame of the photos' poses, instead of the points."""
    render: Literal["merged", "composited"] = "merged"
    """How whole pictures are drawn: all Gaussians at once, as any viewer will, or block by block."""

    ownership: tyro.conf.Fixed[Literal["fragments", "means"]] = "fragments"
    """What a layer holds in composited pictures; set by the method's recipe."""
    primitive: tyro.conf.Fixed[PrimitiveName] = "3dgs"
    """What a Gaussian is; set by the run's options."""


class AbcdModel(SplatfactoModel):
    """Draws batches for training and whole pictures for evaluation, viewer and export.

    While training, the registered parameters are the active block alone; the coordinator has the rest of the
    scene. Otherwise (ns-eval, ns-export, ns-viewer, ns-render) they are the merged scene, on the device or,
    where that cannot draw it at once, on the CPU. `state_dict` returns the merged scene in either case.
    """

    config: AbcdModelConfig

    def populate_modules(self) -> None:
        """Register empty parameters; a run fills them when it begins."""
        empty = Gaussians.empty(self.config.sh_degree)
        self.gauss_params = ParameterDict({name: Parameter(value) for name, value in empty.items()})
        cameras = {"num_cameras": self.num_train_data, "device": "cpu"}
        self.camera_optimizer = self.config.camera_optimizer.setup(**cameras)
        self._tree, self._poses = build_kd(torch.zeros(0, 3), 1), {}
        self.near = NEAR_PLANE
        self.step = 0
        # For derived classes, as splatfacto has them; here images are measured by `metrics`.
        self.psnr = psnr
        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self.crop_box: OrientedBox | None = None
        color = self.config.background_color
        self.background_color = torch.tensor(VIEWER_BACKGROUND) if color == "random" else get_color(color)
        self.choice = viewed.Choice()
        self._coordinator: Trainer | None = None
        self._rasterizer: Rasterizer | None = None
        self._loaded_is_too_large = False
        self._parted: tuple[Parameter, BlockTree, MemoryScene] | None = None

    def follow(self, coordinator: Trainer) -> None:
        """The scene is the coordinator's from now on, and the registered parameters its active block."""
        self._coordinator, self._parted = coordinator, None

    def draws_with(self) -> Rasterizer:
        """The rasterizer, made on first use."""
        if self._rasterizer is None:
            name, primitive = self.config.rasterizer, self.config.primitive
            self._rasterizer = make_rasterizer(name, self.device, primitive=primitive)
        return self._rasterizer

    @property
    def tree(self) -> BlockTree:
        """How space is cut; while training, as it is now."""
        return self._tree if self._coordinator is None else self._coordinator.scene.tree

    @property
    def poses(self) -> dict[int, Tensor]:
        """Refined poses, world to camera, by row of the training photos."""
        return self._poses if self._coordinator is None else self._coordinator.run.poses.refined

    @property
    def colors(self) -> Tensor:
        """RGB by harmonics of degree 0, [n, 3]. With no others, splatfacto's parameters are logits."""
        return SH2RGB(self.features_dc)

    @property
    def shs_0(self) -> Tensor:
        """The harmonics of degree 0, [n, 3]; as `colors`."""
        return self.features_dc

    def scene(self) -> BlockScene:
        """The whole scene by blocks, the active one included."""
        if self._coordinator is not None:
            return self._coordinator.scene
        means, tree = self.gauss_params["means"], self.tree
        if self._parted is None or self._parted[0] is not means or self._parted[1] is not tree:
            self._parted = means, tree, MemoryScene(tree, self.merged())
        return self._parted[2]

    def merged(self, device: torch.device | str = "cpu") -> Gaussians:
        """The whole scene, detached; while training, on `device` and perhaps read from disk."""
        if self._coordinator is None:
            return active_gaussians(self.gauss_params).detach()
        return self._coordinator.scene.everything(device)

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """The merged scene under splatfacto's names, whatever is active."""
        state = super().state_dict(*args, **kwargs)
        if self._coordinator is not None:
            prefix, merged = kwargs.get("prefix", ""), self.merged()
            state.update({f"{prefix}gauss_params.{n}": value for n, value in merged.items()})
            state[f"{prefix}_extra_state"]["checksum"] = checksum(merged)
        return state

    def load_state_dict(self, state: dict[str, Any], **kwargs: Any) -> None:
        """As splatfacto's, but on the CPU where the scene is too large for the device. A UserError if the
        Gaussians are not those that were saved: torch.load accepts altered bytes."""
        expected = state.get("_extra_state", {}).get("checksum")
        count = len(state["gauss_params.means"])
        self._loaded_is_too_large = count > self._most_at_once()
        home = torch.device("cpu") if self._loaded_is_too_large else self.device
        for name, value in list(self.gauss_params.items()):
            self.gauss_params[name] = Parameter(torch.empty((count, *value.shape[1:]), device=home))
        super(SplatfactoModel, self).load_state_dict(state, **kwargs)  # splatfacto's takes all to the device
        if expected is not None and checksum(active_gaussians(self.gauss_params)) != expected:
            raise UserError(
                "This checkpoint is damaged: the checksum of its Gaussians is wrong. Go on with the run by "
                "`ns-train --load-dir`, which saves another, or take an older one."
            )

    def get_extra_state(self) -> dict[str, Any]:
        """What is no parameter: the tree, the near plane, refined poses and the names of their photos."""
        return {"tree": self.tree.to_json(), "near": self.near, "poses": self.poses, "photos": self._photos}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._tree = BlockTree.from_json(state["tree"])
        self.near = state.get("near", NEAR_PLANE)
        self._poses = state.get("poses", {})
        if self._poses and state.get("photos", self._photos) != self._photos:  # old checkpoints have no names
            say("These are not the photos of the run: its refined poses are not used.", "yellow")
            self._poses = {}

    @property
    def _photos(self) -> list[str]:
        """Names of the training photos; readers differ in the case and ending of some."""
        return [source.path.stem.casefold() for source in self.kwargs.get("metadata", {}).get(PHOTOS, ())]

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:
        """The crops of a training batch where the camera carries one, else the whole picture."""
        batch = (camera.metadata or {}).get(BATCH)
        if self.training and batch is not None:
            rendered = self._coordinator.render(batch)
            pictures = {"rgb": list(rendered.pictures), "background": [s.background for s in batch.samples]}
            return {**pictures, "batch": batch, "rendered": rendered}
        with as_a_command():
            return self._whole_outputs(self.view(camera))

    def view(self, camera: Cameras) -> View:
        """The camera as the engine draws it: on the CPU, from the scene's near plane on. A UserError if it is
        no perspective camera; the viewer, which previews paths of others, gets one."""
        if not isinstance(camera, Cameras):
            raise UserError("Gaussians are drawn by cameras, not by rays; `abcd mesh RUN` makes a mesh.")
        camera = camera.to("cpu")
        if viewed.asked_by_viewer():
            camera.camera_type = torch.full_like(camera.camera_type, CameraType.PERSPECTIVE.value)
        return replace(view_of(camera), near=self.near)

    def set_background(self, background_color: Tensor) -> None:
        """The viewer's, which counts where the config leaves it open, as with splatfacto."""
        if self.config.background_color == "random":
            super().set_background(background_color)

    def _whole_outputs(self, view: View) -> dict[str, Tensor]:
        # ns-render's crop has a background of its own.
        override = renderers.BACKGROUND_COLOR_OVERRIDE
        background = (self.background_color if override is None else override).to(self.device)
        if viewed.asked_by_viewer():
            view = viewed.bounded(view)
            raster = self.draw_for_viewer(view)
            layer = raster.layer
        else:
            raster = self.draw_merged(view)
            layer = self.draw_composited(view) if self.config.render == "composited" else raster.layer
        later = {"normals": partial(self.draw_normals, view), "depth_median": partial(self.draw_median, view)}
        outputs = Outputs(pictured(layer, raster, background), later)
        outputs.draw(viewed.chosen_outputs())  # now, while training waits for the viewer
        return outputs

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """ns-render's `rgba`: an output without its background, [H, W, 4], alpha not multiplied in."""
        alpha = outputs["accumulation"]
        color = (outputs[output_name] - (1 - alpha) * outputs["background"]) / alpha.clamp_min(1e-10)
        return torch.cat((color.clamp(0, 1), alpha), dim=-1)

    @torch.no_grad()
    def draw_merged(self, view: View) -> Raster:
        """All Gaussians at once, sorted by depth, as ordinary viewers draw them. Where the device cannot hold
        them all, fragments are drawn node by node and fold to the same picture."""
        training, too_large = self._coordinator, self._loaded_is_too_large
        if training is not None:
            too_large = training.count() > min(default_pass(self.scene()), self._most_at_once())
        if too_large:
            return self._by_nodes(view, "fragments").draw(viewed.Show.EVERYTHING, None)
        gaussians = self._crop(self.merged(self.device).to(self.device))
        return self.draws_with()(gaussians, view, **vars(self._settings()))

    @torch.no_grad()
    def draw_composited(self, view: View) -> Layer:
        """Each block alone, then folded front to back: what block training composites."""
        pictures = self._by_nodes(view, self.config.ownership, pass_gaussians=0)
        return pictures.renderer.picture(view, pictures.settings).layer

    @torch.no_grad()
    def draw_normals(self, view: View) -> Tensor:
        """World-space normals of what the viewer shows, (n + 1) / 2, [H, W, 3]."""
        paint = partial(colored_by_normal, view=view, flat=self.config.primitive == "2dgs")
        pictures = self._by_nodes(view, "fragments", keep=lambda g: paint(self._crop(g)), sh_degree=0)
        show = self.choice.show if viewed.asked_by_viewer() else viewed.Show.EVERYTHING
        return (normals_in(pictures.draw(show, self._chosen_block())) + 1) / 2

    @torch.no_grad()
    def fog(self, view: View) -> float:
        """Share of the screen covered by Gaussians before the view's nearest point, 0..1."""
        pictures = self._by_nodes(view, "fragments", keep=lambda g: fog_in_white(g, view), sh_degree=0)
        return float(pictures.draw(viewed.Show.EVERYTHING, None).color.mean())

    @torch.no_grad()
    def draw_median(self, view: View) -> Tensor:
        """The depth at which half of each pixel is covered, [H, W, 1]."""
        pictures = self._by_nodes(view, "fragments")
        return median_depth(pictures.renderer, view, pictures.settings)[..., None]

    def draw_for_viewer(self, view: View) -> Raster:
        """What the viewer's user chose to see."""
        choice, block = self.choice, self._chosen_block()
        if choice.show is viewed.Show.EVERYTHING or block is None:
            return self.draw_merged(view)
        return self._by_nodes(view, self.config.ownership).draw(choice.show, block)

    def _chosen_block(self) -> int | None:
        """The block that the viewer's user chose; None if there is no such block."""
        block = self.choice.block
        if block is None and self._coordinator is not None:
            active = self._coordinator.state.active
            block = None if active is None or active.is_whole else active.geometry.block
        return block if block is not None and block < self.tree.num_blocks else None

    def _by_nodes(
        self,
        view: View,
        ownership: Ownership,
        *,
        pass_gaussians: int | None = None,
        keep: Callable[[Gaussians], Gaussians] | None = None,
        sh_degree: int | None = None,
    ) -> viewed.BlockPictures:
        """Draws the scene by parts: what `keep` leaves of its Gaussians, or those in the crop box."""
        whole = self.scene()
        if isinstance(whole, StoredScene) and whole.is_active_as_a_whole:
            whole = MemoryScene(whole.tree, self.merged())  # whose blocks are known
        shown = keep or self._crop
        scene = ChangedScene(whole, lambda _, found: shown(found))
        if pass_gaussians is None:
            pass_gaussians = min(default_pass(scene), self._most_at_once())
        options = {"ownership": ownership, "pass_gaussians": pass_gaussians, "device": self.device}
        renderer = LayerRenderer(scene, self.draws_with(), **options)
        training = TrainingConfig() if self._coordinator is None else self._coordinator.config
        return viewed.BlockPictures(renderer, view, self._settings(sh_degree), training.recipe.window_weight)

    def _settings(self, sh_degree: int | None = None) -> RenderSettings:
        degree = self.config.sh_degree if sh_degree is None else sh_degree
        return RenderSettings(degree, self.config.rasterize_mode == "antialiased")

    def _most_at_once(self) -> int:
        """Gaussians that the device's free memory allows to draw at once."""
        of_each = frozen_bytes(self.config.sh_degree, self.config.primitive)
        return int(FREE_SHARE * free_bytes(self.device)) // of_each

    def _crop(self, gaussians: Gaussians) -> Gaussians:
        if self.crop_box is None:
            return gaussians
        return gaussians[self.crop_box.within(gaussians.means).reshape(-1)]

    def get_metrics_dict(self, outputs: Values, batch: Values) -> Values:
        """PSNR, a batch's mean, and the number of Gaussians in the scene. Leaves the mean squared error of
        each picture in `outputs` for the pipeline."""
        pictures, photos = self._pairs(outputs, batch)
        errors = outputs["errors"] = squared_errors(pictures, photos)
        count = len(self.gauss_params["means"]) if self._coordinator is None else self._coordinator.count()
        return {"psnr": -10 * torch.stack(errors).log10().mean(), "gaussian_count": count}

    def get_loss_dict(self, outputs: Values, batch: Values, metrics_dict: Values | None = None) -> Values:
        """The coordinator's loss of a training batch; of a whole picture the photometric loss."""
        del metrics_dict
        pictures, photos = self._pairs(outputs, batch)
        if "batch" in outputs and self._coordinator is not None:
            return {"main_loss": self._coordinator.loss(outputs["batch"], pictures, photos)}
        height, width = pictures[0].shape[:2]
        whole = {"full_pixels": height * width, "full_windows": ssim_windows(height, width)}
        loss = photometric_loss(pictures[0], photos[0], ssim_lambda=self.config.ssim_lambda, **whole)
        return {"main_loss": loss}

    def _pairs(self, outputs: Values, batch: Values) -> tuple[list[Tensor], list[Tensor]]:
        """Pictures and their photos, on the same background, black where masks hide them."""
        backgrounds = zip(as_list(batch["image"]), as_list(outputs["background"]), strict=True)
        photos = [self.composite_with_background(self.get_gt_img(image), b) for image, b in backgrounds]
        pictures, masks = as_list(outputs["rgb"]), as_list(batch.get("mask", [None] * len(photos)))
        return masked(pictures, masks), masked(photos, masks)

    def get_image_metrics_and_images(self, outputs: Values, batch: Values) -> tuple[Values, Values]:
        """Metrics of a whole picture, and photo and picture side by side."""
        (picture,), (photo,) = self._pairs(outputs, batch)
        found = image_metrics(picture, photo, self.config.color_corrected_metrics, batch.get("mask"))
        return found, {"img": torch.cat([photo, picture], dim=1)}

    def get_gt_img(self, image: Tensor) -> Tensor:
        """A photo as float32 in 0..1 on the device; photos of samples are float already."""
        return (image.float() / 255 if image.dtype == torch.uint8 else image).to(self.device)
