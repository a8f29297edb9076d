"""What each format of `abcd export` costs: bytes a Gaussian, and what its pictures lose against the .ply's.

    python -m benchmarks.formats outputs/SCENE/METHOD/TIME --data SCENE

Each file is read back (.glb by its own layout, the packed ones by gaussforge), and the run's held-out views
are drawn from it, in the frame of the data. Printed: bytes a Gaussian, seconds to write, PSNR of the pictures
against those of the .ply, and held-out PSNR.
"""

import json
import math
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Annotated

import numpy as np
import torch
import tyro
from plyfile import PlyData

from abcd_ns.cli.export.command import TRANSFORMS, export
from abcd_ns.cli.report.run_folder import load_pipeline, open_run
from abcd_ns.engine.gaussians.frames import Frame
from abcd_ns.engine.types import Gaussians
from abcd_ns.formats.glb import attributes
from abcd_ns.formats.ply import columns
from abcd_ns.formats.scene_file import SUFFIXES
from abcd_ns.lab.runs.evaluate import held_out_views, undisturbed
from abcd_ns.nerfstudio.pipeline import AbcdPipeline


def from_rows(table: np.ndarray) -> Gaussians:
    """Of a .ply's columns without the normals, degree 3."""
    values = torch.from_numpy(np.ascontiguousarray(table, dtype=np.float32))
    means, dc, rest, opacities, scales, quats = values.split((3, 3, 45, 1, 3, 4), dim=1)
    return Gaussians(means, scales, quats, dc, rest.unflatten(1, (3, 15)).transpose(1, 2), opacities)


def read_ply(content: Path) -> Gaussians:
    """A .ply of degree 3."""
    vertices = PlyData.read(str(content))["vertex"].data
    return from_rows(np.stack([vertices[n] for n in columns(3) if not n.startswith("n")], axis=1))


def read_glb(path: Path) -> Gaussians:
    """A .glb that this package wrote, degree 3."""
    content = path.read_bytes()
    words = int.from_bytes(content[12:16], "little")
    document, parts = json.loads(content[20 : 20 + words]), attributes(3)
    count, found = document["accessors"][0]["count"], []
    for part, view in zip(parts, document["bufferViews"], strict=True):
        if part.name != "COLOR_0":
            values = np.frombuffer(content, "<f4", count * part.stride // 4, 28 + words + view["byteOffset"])
            found.append(torch.from_numpy(values.reshape(count, -1).copy()))
    means, quats, scales, opacities, dc, *rest = found
    return Gaussians(means, scales.log(), quats[:, [3, 0, 1, 2]], dc, torch.stack(rest, 1), opacities.logit())


def read(path: Path, suffix: str, folder: Path) -> Gaussians:
    """Any of the formats."""
    if suffix == ".glb":
        return read_glb(path)
    if suffix != ".ply":
        import gaussforge

        back = gaussforge.GaussForge().convert(path.read_bytes(), suffix[1:], "ply")
        path = folder / f"back{suffix[1:].replace('.', '-')}.ply"
        path.write_bytes(back["data"])
    return read_ply(path)


def pictures(pipeline: AbcdPipeline, scene: Gaussians) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Each held-out view drawn from a scene in the run's frame, and its photo."""
    model = pipeline.model
    with undisturbed(pipeline), torch.no_grad():
        for held_out in held_out_views(pipeline):
            layer = model.draws_with()(scene, model.view(held_out.camera), sh_degree=3).layer
            picture = layer.color + layer.transmittance[..., None] * model.background_color
            yield picture.clamp(0, 1), held_out.photo


def decibels(squared: float) -> float:
    """PSNR of a mean squared error."""
    return math.inf if squared == 0 else -10 * math.log10(squared)


def main(run: Annotated[Path, tyro.conf.Positional], /, *, data: Path) -> None:
    """Print a table."""
    found = open_run(run)
    pipeline = load_pipeline(found, found.checkpoint, data)
    known = json.loads((run / TRANSFORMS).read_text())
    matrix = torch.tensor(known["transform"], dtype=torch.float64)
    frame, plain = Frame(matrix[:, :3], matrix[:, 3], known["scale"]), []
    with tempfile.TemporaryDirectory() as place:
        for suffix in sorted(SUFFIXES, key=lambda s: s != ".ply"):
            path, began = Path(place) / f"scene{suffix}", time.perf_counter()
            export(run, out=path)
            seconds, scene = time.perf_counter() - began, read(path, suffix, Path(place))
            drawn = list(pictures(pipeline, frame.gaussians(scene)))
            plain = plain or [picture for picture, _ in drawn]
            against = fmean(float((p - q).square().mean()) for (p, _), q in zip(drawn, plain, strict=True))
            psnr = fmean(decibels(float((p - photo).square().mean())) for p, photo in drawn)
            size = path.stat().st_size / len(scene)
            print(f"{suffix}: {size:.1f} bytes, {seconds:.1f} s, {decibels(against):.1f} dB, {psnr:.3f} dB")


if __name__ == "__main__":
    tyro.cli(main)
