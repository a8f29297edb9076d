"""Training and rendering from Python: the engine without nerfstudio."""

import logging
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from abcd_ns.cluster.forked_workers import can_fork
from abcd_ns.engine.events import Event
from abcd_ns.engine.gaussians.param_swap import nothing_active
from abcd_ns.engine.layers.compositing import composite
from abcd_ns.engine.render import PrimitiveName, make_rasterizer
from abcd_ns.engine.render.rasterization import rasterizer_on
from abcd_ns.engine.space.distances import as_trained
from abcd_ns.engine.store.manifest import manifest_path
from abcd_ns.engine.train import training_loop
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.types import Crop, Gaussians, View, centers_of
from abcd_ns.errors import UserError
from abcd_ns.run import STATE, STORE
from abcd_ns.run.begin import Capture, begin_run, cloud_of
from abcd_ns.run.options import RunOptions

LOG = logging.getLogger("abcd_ns")

Photo = UInt8[Tensor, "_h _w 3"] | Float[Tensor, "_h _w 3"]  # 0..255 as integers, or 0..1
REAL, INTEGER = (-0.5, 2.0), (0.0, 255.0)  # values of photos; filters go beyond 0..1
MOST_STRETCH = 2e-2  # of R R^T from the identity
LOST_DIGITS = 1e-3  # rounding of positions above this share of a view's reach may show in pictures


@dataclass(frozen=True)
class TrainedScene:
    """Gaussians, and how they were drawn in training."""

    gaussians: Gaussians
    """On the CPU, before activation."""
    near: float
    """Nothing closer to a camera is drawn; world units along its axis."""
    antialiased: bool
    primitive: PrimitiveName


def train(
    views: Sequence[View],
    photos: Sequence[Photo],
    points: tuple[Float[Tensor, "n 3"], UInt8[Tensor, "n 3"]],
    out: Path | str,
    *,
    steps: int = 30_000,
    options: RunOptions | None = None,
    device: torch.device | str | None = None,
    listener: Callable[[Event], None] | None = None,
) -> TrainedScene:
    """Train a scene as `ns-train abcd` does.

    Args:
        views: cameras in one world space. Their `index` and `near` are set here.
        photos: one for each view, of its size. A sequence may read them when they are asked for.
        points: places in world space, and colours 0..255. These and photos may be NumPy arrays.
        out: folder of the run. Blocks are kept in its `abcd/store` as they are trained.
        steps: optimisation steps for the whole scene.
        options: None for the defaults.
        device: None for a GPU if there is one.
        listener: called with each event of `abcd_ns.engine.events`.

    Raises:
        UserError: photos and views do not match, an option is out of range, `out` holds a run already, or
            nothing fits on the device.
    """
    options, folder = options or RunOptions(), Path(out) / STATE / STORE
    device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    training, (places, colors) = options.training, map(torch.as_tensor, points)
    _check_run(steps, options, device, folder)
    _check_views(views, photos)
    _check_points(places, colors)
    numbered = [replace(view.to("cpu"), index=index) for index, view in enumerate(views)]
    views = as_trained(numbered, places, options.near_plane)
    _warn_of_rounding(views)

    def photo(index: int, crop: Crop) -> Float[Tensor, "h w 3"]:
        pixels = torch.as_tensor(photos[index])[crop.slices]
        return (pixels.float() if pixels.is_floating_point() else pixels.float() / 255).to(device)

    def target(sample: Sample) -> Target:
        return sample.reduced(photo(sample.view.index, sample.source)), None

    names = [Path(str(view.index)) for view in views]
    capture = Capture(views, names, target, partial(cloud_of, places, colors, views, training), len(places))
    rasterizer = make_rasterizer("auto", device, primitive=training.primitive)
    empty, budget = nothing_active(training.sh_degree, device), Budget(steps, options.max_seconds)
    threads = torch.get_num_threads()  # the kernels' own may take their place meanwhile
    try:
        trainer = begin_run(options, capture, device, folder, budget, rasterizer, *empty, LOG.info)
        with closing(trainer):
            if listener is not None:
                trainer.announce.subscribe(listener)
            training_loop.train(trainer, photo)
            trainer.save()
            gaussians = trainer.scene.everything("cpu")
    finally:
        torch.set_num_threads(threads)
    return TrainedScene(gaussians, views[0].near, training.antialiased, training.primitive)


@torch.no_grad()
def render(
    scene: TrainedScene,
    view: View,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    device: torch.device | str | None = None,
) -> Float[Tensor, "h w 3"]:
    """A picture of a trained scene, 0..1, on the device.

    Args:
        view: any camera in the world space of the training views.
        background: colour where nothing is.
        device: None for a GPU if there is one.
    """
    device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    gaussians, placed = scene.gaussians.to(device), replace(view.to("cpu"), near=scene.near)
    options = {"sh_degree": gaussians.sh_degree, "antialiased": scene.antialiased}
    raster = rasterizer_on(device, scene.primitive)(gaussians, placed, **options)
    return composite(raster.layer, torch.tensor(background, device=device)).clamp(0, 1)


def _check_points(places: Tensor, colors: Tensor) -> None:
    if not 0 < len(places) == len(colors):
        raise UserError(f"There are {len(places)} points and {len(colors)} colours: give one for each.")
    if places.shape[1:] != (3,) or colors.shape[1:] != (3,):
        raise UserError(
            f"Points and colours are {[*places.shape]} and {[*colors.shape]}: both must be [n, 3]."
        )
    low, high = map(float, colors.float().aminmax())
    if not 0 <= low <= high <= 255 or (colors.is_floating_point() and 0 < high <= 1):
        raise UserError(f"Colours of points are from {low:g} to {high:g}: scale them to 0..255.")
    if not places.isfinite().all(dim=1).any():
        raise UserError("No point is finite: give points in the world space of the views.")


def _check_views(views: Sequence[View], photos: Sequence[Photo]) -> None:
    if len(views) != len(photos) or not views:
        raise UserError(f"There are {len(views)} views and {len(photos)} photos: give a photo for each view.")
    for index, view in enumerate(views):
        photo = torch.as_tensor(photos[index])
        if tuple(photo.shape) != (view.height, view.width, 3):
            wanted, shape = [view.height, view.width, 3], list(photo.shape)
            raise UserError(f"Photo {index} has shape {shape}, but its view has {wanted}.")
        if photo.dtype != torch.uint8:
            least, most = map(float, photo.float().aminmax())
            low, high = REAL if photo.is_floating_point() else INTEGER
            if photo.dtype == torch.bool or not low <= least <= most <= high:
                right = "give integers 0..255, or real numbers 0..1"
                raise UserError(f"Photo {index} has values from {least:g} to {most:g}: {right}.")
        turn, side = view.viewmat[:3, :3].double(), max(view.width, view.height)
        is_rigid = float((turn @ turn.T - torch.eye(3).to(turn)).abs().max()) <= MOST_STRETCH
        if not (is_rigid and view.viewmat.isfinite().all()):
            raise UserError(f"View {index} has a viewmat that is no rotation and translation: repair it.")
        if not all(side / 50 < focal < side * 1000 for focal in view.K.diagonal()[:2].tolist()):
            raise UserError(f"View {index} has a focal length that no camera has: K must be in pixels.")


def _warn_of_rounding(views: list[View]) -> None:
    farthest = float(centers_of(views).abs().max())
    off = farthest * torch.finfo(torch.float32).eps
    if off > LOST_DIGITS * min(view.reach for view in views):
        far = f"Cameras are {farthest:,.0f} units from the origin, where float32 rounds to {off:.1g}"
        LOG.warning(f"{far}: the scene may be less sharp. Move views and points near the origin.")


def _check_run(steps: int, options: RunOptions, device: torch.device, folder: Path) -> None:
    try:
        msgspec.convert(msgspec.to_builtins(options, enc_hook=lambda number: number.item()), RunOptions)
    except msgspec.ValidationError as error:
        raise UserError(f"options: {error}.") from None
    options.check_ranges()
    if steps < 1:
        raise UserError(f"steps must be at least 1, not {steps}.")
    if manifest_path(folder).exists():
        raise UserError(f"{folder} holds a run already: choose another folder for `out`.")
    if options.cluster is not None or (options.workers > 1 and not can_fork(device)):
        raise UserError("Workers on GPUs or a cluster need ns-train: leave out workers and cluster.")
