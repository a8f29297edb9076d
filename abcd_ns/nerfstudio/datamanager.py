"""Serves the crops of photos that the active block is trained on, with its cached F and B layers."""

import random
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import torch
import tyro
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
)
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from torch.utils.data import DataLoader

from abcd_ns.data.dataset import AbcdDataset, has_views
from abcd_ns.data.input_errors import InputError, say
from abcd_ns.engine.events import Event, PhotosWanted
from abcd_ns.engine.train.schedule import evenly
from abcd_ns.engine.train.step.batch import Batch, Sample, Target
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.transfer import upload
from abcd_ns.engine.types import Crop
from abcd_ns.errors import IMPORT_TROUBLE
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.flags import hidden, shown
from abcd_ns.nerfstudio.views import place_cameras
from abcd_ns.units import GIB

BATCH = "abcd_batch"  # the key of a camera's metadata that holds what the model trains on
TROUBLE = (*IMPORT_TROUBLE, ArithmeticError, AssertionError, LookupError)
"""What readers raise where data is not what they expect."""

OUR_READER = "abcd-data"
READERS: dict[str, DataParserConfig] = {
    OUR_READER: AbcdDataParserConfig(),
    **{name: config for name, config in all_dataparsers.items() if name != OUR_READER},
    "nerfstudio-data": NerfstudioDataParserConfig(load_3D_points=True),  # as splatfacto has it
}
"""What reads data, by the name on the command line."""
DataFormat = tyro.conf.OmitSubcommandPrefixes[
    tyro.extras.subcommand_type_from_defaults(READERS, prefix_names=False) | None
]
"""A subcommand for each of READERS; None by default."""

SELECTED = 1024
"""Training cameras that are kept, each by itself: selecting one takes nerfstudio 0.3 ms, in every step."""
_TURNS = "each block takes its views in shuffled turns"
_CHOICES = ("num_images_to_sample_from", "num_times_to_repeat_images", "image_indices")
UNUSED = {
    "cache_images": "photos are kept on the device and in RAM as far as --pipeline.ram-budget-gb and "
    "--pipeline.device-budget-gb allow",
    "cache_images_type": "photos are kept as they are stored, 8 bits a channel",
    **dict.fromkeys(("images_on_gpu", "masks_on_gpu"), "--pipeline.device-budget-gb decides what is kept"),
    "max_thread_workers": "photos are read ahead of the steps on a GPU, and on a CPU when they are needed",
    **dict.fromkeys(("train_cameras_sampling_strategy", "fps_reset_every"), _TURNS),
    "train_cameras_sampling_seed": "the order of views follows --machine.seed",
    "camera_res_scale_factor": "the reader of data reduces photos, by its --downscale-factor",
    **{f"eval_{name}": "all held-out photos are evaluated" for name in _CHOICES},
}
"""Options of nerfstudio's datamanager that ABCD has no use for, and why."""


def reader_name(config: DataParserConfig) -> str:
    """The name of a reader on the command line, or of its class where it has none."""
    kind = type(config)
    return next((name for name, known in READERS.items() if type(known) is kind), kind.__name__)


@contextmanager
def reading(config: DataParserConfig) -> Iterator[None]:
    """Turn what a reader raises into an InputError of one sentence."""
    name = reader_name(config)
    try:
        yield
    except EOFError as error:  # of input()
        raise InputError(
            f"{name} asks the question above, and there is no terminal to answer it: run the command in "
            f"one, or change what it is about by an option of `ns-train abcd {name} --help`."
        ) from error
    except TROUBLE as error:
        raise InputError(
            f"{name} cannot read {config.data} ({type(error).__name__}: {error}); `ns-train abcd {name} "
            "--help` lists its options."
        ) from error


@shown("dataparser", "data_format")
@hidden(*UNUSED)
@dataclass
class AbcdDataManagerConfig(FullImageDatamanagerConfig):
    """Photos, served by crop to the block in training."""

    _target: type = field(default_factory=lambda: AbcdDataManager)
    dataparser: DataParserConfig = field(default_factory=AbcdDataParserConfig)
    """How the data is read. Another reader may end the command: `ns-train abcd --data DIR colmap`."""
    data_format: DataFormat = None
    """What reads the data, if not abcd-data. Its own options follow its name."""
    cache_images: Literal["cpu", "gpu"] = "cpu"
    """Unused, see UNUSED. nerfstudio prints a line where it is "gpu"."""
    photo_cache_gb: float = 0.0
    """RAM for decoded photos, GiB; 0 takes the photos' share of `pipeline.ram_budget_gb`."""
    poses: ClassVar[Mapping[int, torch.Tensor]] = MappingProxyType({})
    """Refined poses of a run that was opened; `ns-render dataset` makes more datamanagers of this config."""
    background: ClassVar[Sequence[float]] = (0.0, 0.0, 0.0)
    """Likewise what its pictures are drawn on, for photos with alpha."""

    def __post_init__(self) -> None:
        if self.data_format is None:
            return
        if self.dataparser != AbcdDataParserConfig():
            raise ValueError(
                "--pipeline.datamanager.dataparser.* are options of abcd-data: give another reader its own, "
                "without that prefix, after its name"
            )
        self.dataparser, self.data_format = self.data_format, None

    def reader(self) -> DataParserConfig:
        """What reads the data, with its folder."""
        return self.dataparser if self.data is None else replace(self.dataparser, data=self.data)


class AbcdDataManager(FullImageDatamanager[AbcdDataset]):
    """Serves the photos of what the coordinator trains on."""

    config: AbcdDataManagerConfig
    train_dataset: AbcdDataset
    eval_dataset: AbcdDataset

    device_photo_bytes: int = 0
    """For decoded training photos and masks on a GPU. Crops of others are copied there in each step."""
    scored: int | None = None
    """Number of held-out views to score; None for all."""

    def __init__(self, config: AbcdDataManagerConfig, *args: Any, **kwargs: Any) -> None:
        self._coordinator: Trainer | None = None
        self._on_device: dict[tuple[str, int], torch.Tensor] = {}
        self._used = 0
        self._parts: list[Batch] = []
        # Ours says itself what is wrong with data; other errors are its bugs.
        reader = config.reader()
        with nullcontext() if reader_name(reader) == OUR_READER else reading(reader):
            super().__init__(config, *args, **kwargs)
        self._eval_order = random.Random(0)
        cameras = self.train_dataset.cameras
        self._camera = lru_cache(SELECTED)(lambda row: cameras[row : row + 1])
        self.take_poses(config.poses)

    def create_train_dataset(self) -> AbcdDataset:
        """The training photos, under their share of RAM."""
        budget = int(self.config.photo_cache_gb * GIB) if self.config.photo_cache_gb else None
        return self._dataset(self.train_dataparser_outputs, budget)

    def _dataset(self, outputs: DataparserOutputs, budget: int | None) -> AbcdDataset:
        needs_photos = self.test_mode != "inference"  # viewing and exporting need none
        behind = self.config.background
        return AbcdDataset(outputs, budget_bytes=budget, needs_photos=needs_photos, behind=behind)

    def create_eval_dataset(self) -> AbcdDataset:
        """The held-out photos; none is kept in RAM."""
        outputs = self.dataparser.get_dataparser_outputs(split=self.test_split)
        if not has_views(outputs):
            say("No held-out view can be used: scores are of the training views.", "yellow")
            outputs = self.train_dataparser_outputs
        return self._dataset(outputs, 0)

    def follow(self, coordinator: Trainer) -> None:
        """Serve this coordinator from now on."""
        self._coordinator = coordinator
        coordinator.announce.subscribe(self.read_ahead)

    def take_poses(self, poses: Mapping[int, torch.Tensor]) -> None:
        """Move cameras of both splits to refined poses: world to camera, by row of the training photos."""
        rows = {path: row for row, path in enumerate(self.train_dataset.image_filenames)}
        for dataset in (self.train_dataset, self.eval_dataset):
            known = ((row, rows.get(path, -1)) for row, path in enumerate(dataset.image_filenames))
            place_cameras(dataset.cameras, {row: poses[own] for row, own in known if own in poses})

    def photo(self, row: int, crop: Crop) -> torch.Tensor:
        """Pixels of a training photo on the device: float32 [h, w, 3 or 4] in 0..1."""
        return self._pixels("image", row, crop).float() / 255

    def target(self, sample: Sample) -> Target:
        """A sample's photo, composited on its background, and its mask."""
        shot = sample.view.index, sample.source
        photo = sample.reduced(self.photo(*shot))
        if photo.shape[-1] == 4:  # as splatfacto's model composites
            photo = photo[..., 3:] * photo[..., :3] + (1 - photo[..., 3:]) * sample.background
        return photo, sample.reduced_mask(self._pixels("mask", *shot))

    def read_ahead(self, event: Event) -> None:
        """Begin to read photos that are wanted soon, except on a CPU, whose threads are busy."""
        if isinstance(event, PhotosWanted) and torch.device(self.device).type != "cpu":
            rows = (row for row in event.views if ("image", row) not in self._on_device)
            self.train_dataset.photos.expect(rows)

    def _pixels(self, kind: Literal["image", "mask"], row: int, crop: Crop) -> torch.Tensor | None:
        """A crop on the device, of what is kept there or copied; None for no mask."""
        kept = self._on_device.get((kind, row))
        if kept is not None:
            return kept[crop.slices]
        photos, device = self.train_dataset.photos, torch.device(self.device)
        whole = photos.image(row) if kind == "image" else photos.mask(row)
        if whole is None:
            return None
        if device.type == "cpu" or self._used + whole.nbytes > self.device_photo_bytes:
            return upload(whole[crop.slices], device)
        self._used += whole.nbytes
        kept = self._on_device[kind, row] = upload(whole, device)
        return kept[crop.slices]

    def next_train(self, step: int) -> tuple[Cameras, dict[str, Any]]:  # noqa: ARG002 - the coordinator counts
        """The next part of a step's batch: its first camera, with all in the metadata, and its photos."""
        self._parts = self._parts or list(self._coordinator.next_batch().parts())
        samples = self._parts.pop(0)
        rows = [sample.view.index for sample in samples.samples]
        camera = self._camera(rows[0])  # the model asks for its metadata alone
        camera.metadata = {"cam_idx": rows[0], BATCH: samples}
        photos, masks = map(list, zip(*map(self.target, samples.samples), strict=True))
        batch: dict[str, Any] = {"image": photos, "image_idx": rows[0]}
        if any(mask is not None for mask in masks):
            batch["mask"] = masks
        return camera, batch

    @property
    def is_within_step(self) -> bool:
        """Whether `next_train` has more of the same step."""
        return bool(self._parts)

    def next_eval_image(self, step: int) -> tuple[Cameras, dict[str, Any]]:  # noqa: ARG002
        """A random held-out camera and its whole photo."""
        return self._held_out(self._eval_order.randrange(len(self.eval_dataset)))

    @property
    def fixed_indices_eval_dataloader(self) -> DataLoader:
        """Held-out cameras and photos in order, read one at a time: all or `scored`."""
        held_out, own = range(len(self.eval_dataset)), torch.Generator()  # a loader draws a seed
        rows = evenly(held_out, len(held_out) if self.scored is None else self.scored)
        return DataLoader(rows, batch_size=None, collate_fn=self._held_out, generator=own)

    def get_train_rays_per_batch(self) -> int:
        """Pixels of a training photo; nerfstudio's logs divide by it."""
        cameras = self.train_dataset.cameras
        return int(cameras.width[0]) * int(cameras.height[0])

    def _held_out(self, row: int) -> tuple[Cameras, dict[str, Any]]:
        camera = self.eval_dataset.cameras[row : row + 1].to(self.device)
        data = self.eval_dataset.get_data(row, image_type="uint8")
        return camera, {**data, "image": data["image"].to(self.device)}
