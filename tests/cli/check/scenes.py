"""A scene with nothing to complain about, and surveys of what it could have been."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from abcd_ns.cli.check.command import doubts
from abcd_ns.cli.check.survey import Look, Survey, visibility
from abcd_ns.cli.findings import Finding
from tests.data.dataparser_scenes import write_model, write_photos

POINTS = 600


def wide(width: int, height: int) -> tuple[str, list[float]]:
    """A lens that sees all points from everywhere."""
    return "PINHOLE", [width * 0.3, width * 0.3, width / 2, height / 2]


def write_sound(folder: Path) -> Path:
    """Nothing about it is doubtful; its photos have two sizes."""
    write_model(folder / "sparse/0", points=POINTS, params=wide)
    write_photos(folder / "images")
    return folder


def names(found: Survey) -> set[str]:
    """Of what is doubtful about it."""
    return {finding.name for finding in doubts(found)}


def the(name: str, found: Survey) -> Finding:
    (finding,) = (finding for finding in doubts(found) if finding.name == name)
    return finding


def changed(found: Survey, pose: Callable | None = None, points: np.ndarray | None = None) -> Survey:
    """The survey of a scene with other poses, `pose(row, 3 x 4)`, or other points."""
    prepared, scene = found.prepared, found.prepared.scene
    if pose is not None:
        moved = [
            replace(frame, camera_to_world=pose(row, frame.camera_to_world.copy()))
            for row, frame in enumerate(scene.frames)
        ]
        prepared = replace(prepared, scene=replace(scene, frames=moved))
    if points is not None:
        prepared = replace(prepared, points_in_model=points)
    # A new object, as centres are kept with the old one.
    return replace(found, prepared=prepared, seen=visibility(prepared))


def with_brightness(found: Survey, *brightness: float) -> Survey:
    return replace(found, looks=tuple(map(Look, brightness)))
