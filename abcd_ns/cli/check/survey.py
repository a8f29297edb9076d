"""All that `abcd check` knows of a scene; findings and the summary are made from it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from abcd_ns.cli.check.looks import Look, copies, look_at_all
from abcd_ns.cli.check.visibility import Visibility, visibility
from abcd_ns.data.photos import PhotoSource
from abcd_ns.data.prepare import Prepared, check_masks
from abcd_ns.nerfstudio.dataparser import AbcdDataParser, AbcdDataParserConfig
from abcd_ns.nerfstudio.views import training_views


class QuietParser(AbcdDataParser):
    """The reader of training, but for its notes: they are among the findings."""

    def tell(self, note: str) -> None:
        """Nothing."""


@dataclass(frozen=True)
class Survey:
    """A scene that can be read. Lists and rows are in the order of the photos' names."""

    prepared: Prepared
    train: list[int]
    """Rows of the views that are trained on."""
    held_out: list[int]
    near: float
    """The near plane that training takes, in its own units."""
    seen: Visibility
    looks: tuple[Look, ...]
    copies: list[list[int]]
    """Groups of rows with the same photo."""

    @property
    def names(self) -> list[str]:
        """Of the photos."""
        return [frame.name for frame in self.prepared.scene.frames]

    @property
    def sources(self) -> list[PhotoSource]:
        """Of the photos."""
        return self.prepared.sources

    def chosen(self, wanted: Callable[[Look], bool]) -> list[str]:
        """Names of the photos that showed what is wanted."""
        return [name for name, look in zip(self.names, self.looks, strict=True) if wanted(look)]

    @cached_property
    def centers(self) -> np.ndarray:
        """Camera centres float64 [n, 3], model units."""
        return np.stack([frame.camera_to_world[:, 3] for frame in self.prepared.scene.frames])

    @property
    def points(self) -> np.ndarray:
        """The points that training begins with, float64 [m, 3], model units."""
        return self.prepared.points_in_model


def survey(data: Path, downscale: int | None) -> Survey:
    """Read a scene as training does, then look at every photo.

    Raises:
        InputError: training would refuse it; lists all that is wrong.
    """
    parser = QuietParser(AbcdDataParserConfig(data=data, downscale_factor=downscale))
    prepared, outputs = parser.prepared(), parser.get_dataparser_outputs("train")
    check_masks(prepared.sources)
    return Survey(
        prepared=prepared,
        train=parser.rows("train"),
        held_out=parser.rows("test"),
        near=training_views(outputs.cameras, outputs.metadata.get("points3D_xyz"))[0].near,
        seen=visibility(prepared),
        looks=look_at_all(prepared.sources),
        copies=copies(prepared.sources),
    )
