"""Small scenes for tests: Gaussians in a box, cameras around it, photos drawn from a known truth."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from types import UnionType
from typing import Any

import torch
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import MOMENTS, BlockState
from abcd_ns.engine.gaussians.initialize import PointCloud, split_off
from abcd_ns.engine.gaussians.param_swap import Optimizers, Params, attach, nothing_active
from abcd_ns.engine.layers.layer_renderer import LayerRenderer
from abcd_ns.engine.layers.layer_store import LAYER_BYTES
from abcd_ns.engine.render import Rasterizer
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.coarse_model import pack_points, stored_blocks
from abcd_ns.engine.store.scene import MemoryScene, StoredScene
from abcd_ns.engine.store.special_blocks import DEFERRED
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Crop, Gaussians, View
from abcd_ns.lab.world.world import look_at

STILL = DensityConfig(strategy="off")
GROWING = DensityConfig(refine_start=0.0, refine_every=5, split_pixels=0.0)
"""So that runs of a few dozen steps grow."""
UNPRUNED = dataclasses.replace(GROWING, min_contribution=0.0)
"""The same, and nothing is pruned for what it contributes."""


def random_gaussians(
    count: int, seed: int = 0, *, size: float = 0.06, sh_degree: int = 1, dtype=torch.float32
) -> Gaussians:
    """`count` Gaussians with means in [-1, 1]^3, about `size` wide, of all shapes, colours and opacities."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=dtype)

    return Gaussians(
        means=torch.rand((count, 3), generator=generator, dtype=dtype) * 2 - 1,
        scales=math.log(size) + 0.4 * normal(count, 3),
        quats=normal(count, 4),
        features_dc=normal(count, 3),
        features_rest=0.2 * normal(count, (sh_degree + 1) ** 2 - 1, 3),
        opacities=normal(count, 1),
    )


def ring_of_views(
    count: int, *, radius: float = 3.0, width: int = 48, height: int = 36, dtype=torch.float32
) -> list[View]:
    """Cameras on a circle around the origin, at varying heights, all looking at it."""
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=dtype)
    views = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        x, y = radius * math.cos(angle), radius * math.sin(angle)
        eye = torch.tensor([x, y, 0.6 * (index % 3)], dtype=dtype)
        views.append(View(look_at(eye, torch.zeros(3, dtype=dtype)), K, width, height, index))
    return views


class WatchedScene(MemoryScene):
    """Notes the blocks that are read to be drawn."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.read: list[int] = []

    def drawn(self, block: int, *given: Any) -> Gaussians:
        self.read.append(block)
        return super().drawn(block, *given)


def renderer_of(
    scene: Gaussians | MemoryScene, draw: Rasterizer, blocks: int = 4, **options
) -> LayerRenderer:
    """Of a scene, or of Gaussians cut into blocks; by fragments and block by block unless told otherwise."""
    if isinstance(scene, Gaussians):
        scene = MemoryScene(build_kd(scene.means, blocks), scene)
    return LayerRenderer(scene, draw, **{"ownership": "fragments", "pass_gaussians": 0, **options})


class Photos:
    """Photos of `truth`, drawn once; callable as the training loop's photo reader."""

    def __init__(self, truth: Gaussians, views: list[View]) -> None:
        draw = TorchRasterizer()
        with torch.no_grad():
            rasters = {v.index: draw(truth, v, sh_degree=truth.sh_degree) for v in views}
        self.images = {i: r.color.clamp(0, 1) for i, r in rasters.items()}

    def __call__(self, index: int, crop: Crop) -> Tensor:
        return self.images[index][crop.slices]

    def target(self, sample: Sample) -> Target:
        """What a sample's picture should be."""
        return sample.reduced(self(sample.view.index, sample.source)), None


def make_coordinator(
    folder,
    gaussians: Gaussians,
    views: list[View],
    *,
    blocks: int = 4,
    steps: int = 40,
    tree: BlockTree | None = None,
    resume: bool = False,
    coarse_model: int | None = None,
    kind: Callable[[TrainingRun], Trainer] | None = None,
    content: Callable = stored_blocks,
    ram_bytes: int = 2 << 30,
    layer_bytes: int = LAYER_BYTES,
    layer_ram_bytes: int = 0,
    target: Callable | None = None,
    rasterizer: Rasterizer | None = None,
    device: torch.device | str = "cpu",
    **training,
) -> Trainer:
    """A coordinator over a store in `folder`, made from `gaussians` or, with `resume`, opened as it is.

    Args:
        kind: makes another trainer of the run.
        training: options of TrainingConfig, and of its recipe and limits, each by its own name.
    """
    if resume:
        store = ParameterStore.open(folder / "store")
        tree = BlockTree.from_json(store.header["tree"])
    else:
        tree = tree or build_kd(gaussians.means, blocks)
        store = ParameterStore.create(folder / "store", {"tree": tree.to_json()})
        deferred = {}
        if coarse_model is not None:
            gaussians, others = split_off(gaussians, coarse_model, seed=0)
            fields = others.means, others.scales[:, :1], others.quats, others.features_dc, others.sh_degree
            deferred = {DEFERRED: pack_points(PointCloud(*fields))}
        store.commit({**deferred, **dict(content(tree, gaussians))})  # at once: this may be killed
    config = training_config(sh_degree=gaussians.sh_degree, **training)
    scene, active = StoredScene(tree, store, ram_bytes), nothing_active(gaussians.sh_degree, device)
    draws = rasterizer or TorchRasterizer(primitive=config.primitive)
    run = TrainingRun(config, Budget(steps=steps), scene, views, draws, *active, device=device)
    room = LayerRoom(layer_bytes, layer_ram_bytes)
    coordinator = kind(run) if kind else Coordinator(run, room=room, target=target)
    if resume:
        coordinator.restore()
    return coordinator


def activated(gaussians: Gaussians) -> tuple[Params, Optimizers]:
    """Parameters and optimizers in which these are active, without a run."""
    params, optimizers = nothing_active(gaussians.sh_degree)
    attach(BlockState.fresh(gaussians), params, optimizers)
    return params, optimizers


def training_config(**options) -> TrainingConfig:
    """Options of TrainingConfig, and of its recipe and limits, each by its own name; visits are short, and
    steps no larger than 3DGS's: a few dozen of them leave a scene near what it was."""
    options = {"passes": 4, "fast_start": False, "dropout": 0.0, **options}
    parts = {}
    for name, kind in (("recipe", Recipe), ("limits", Limits)):
        fields = {field.name for field in dataclasses.fields(kind)} & set(options)
        parts[name] = kind(**{field: options.pop(field) for field in fields})
    return TrainingConfig(**parts, **options)


def whole_scene(coordinator: Coordinator) -> Gaussians:
    """All blocks in one list, in the order of the blocks, on the CPU."""
    scene = coordinator.scene
    return Gaussians.cat([scene.gaussians(block).to("cpu") for block in range(scene.tree.num_blocks)])


def equal(one: Gaussians, other: Gaussians) -> bool:
    """To the last bit, row by row."""
    return all(torch.equal(value, getattr(other, name)) for name, value in one.items())


def assert_same_state(one: BlockState, other: BlockState) -> None:
    """To the last bit: parameters, moments, statistics, clocks."""
    for part in ("gaussians", *MOMENTS):
        ours, theirs = (dict(getattr(state, part).items()) for state in (one, other))
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(one.growth, other.growth, rtol=0, atol=0)
    assert torch.equal(one.deferred, other.deferred)
    assert one.clocks == other.clocks


def listen(trainer: Trainer, kind: type | UnionType, note: Callable = lambda event: event) -> list[Any]:
    """A list of the events of this kind, or of what `note` makes of each, which grows as they happen."""
    heard: list[Any] = []
    trainer.announce.subscribe(lambda event: heard.append(note(event)) if isinstance(event, kind) else None)
    return heard


def steps_of(trainer: Trainer, photos: Callable) -> Iterator[int]:
    """Train until the budget is used up; the steps so far, after each."""
    while not trainer.finished:
        train_step(trainer, photos)
        yield trainer.state.step


def spoil_gradients(trainer: Trainer, name: str, row: int, value: float, at: int | None = None) -> None:
    """The row's gradient of one parameter is `value` in every step, or after `at` of them: a hook that runs
    before all others."""
    optimizer = trainer.optimizers[name]

    def spoil(optimizer, args, kwargs):  # noqa: ARG001 - torch's signature
        gradient = optimizer.param_groups[0]["params"][0].grad
        if gradient is not None and len(gradient) > row and at in (None, trainer.state.step):
            gradient[row] = value

    handle = optimizer.register_step_pre_hook(spoil)
    optimizer._optimizer_step_pre_hooks.move_to_end(handle.id, last=False)


def stop(trainer: Trainer) -> None:
    trainer.save()
    trainer.close()


def assert_resumes(make: Callable, photos: Callable, *stops: int, **options) -> tuple[Trainer, Trainer]:
    """A run that stops after so many steps and goes on is the run that did not, bit for bit (invariant 7).

    Args:
        make: makes runs by their names and options.

    Returns:
        The run that did not stop, and the last one that did.
    """
    whole = make("whole", **options)
    train(whole, photos)
    for steps in stops:
        stopped = make(f"stopped {steps}", **options)
        train(stopped, photos, steps=steps)
        stop(stopped)
        again = make(f"stopped {steps}", resume=True, **options)
        assert again.state.step == steps
        train(again, photos)
        assert equal(whole_scene(again), whole_scene(whole))
    return whole, again
