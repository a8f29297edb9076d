"""ABCD: Alpha-Composited Block Coordinate Descent for Gaussian Splatting.

`train` and `render` are the engine without nerfstudio, `rasterization` is gsplat's on any device. A name is
imported when it is first used: `import abcd_ns` alone loads nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from abcd_ns.engine.render.rasterization import rasterization as rasterization
    from abcd_ns.engine.train.config import TrainingConfig as TrainingConfig
    from abcd_ns.engine.types import Gaussians as Gaussians
    from abcd_ns.engine.types import View as View
    from abcd_ns.errors import UserError as UserError
    from abcd_ns.run.api import TrainedScene as TrainedScene
    from abcd_ns.run.api import render as render
    from abcd_ns.run.api import train as train
    from abcd_ns.run.options import RunOptions as RunOptions

__version__ = "0.1.0"
_HOMES = {
    "Gaussians": "engine.types",
    "RunOptions": "run.options",
    "TrainedScene": "run.api",
    "TrainingConfig": "engine.train.config",
    "UserError": "errors",
    "View": "engine.types",
    "rasterization": "engine.render.rasterization",
    "render": "run.api",
    "train": "run.api",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'abcd_ns' has no attribute {name!r}")
    return getattr(importlib.import_module(f"abcd_ns.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
