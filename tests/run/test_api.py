"""Training and rendering from Python: the README's lines, the same results as `ns-train`, and refusals."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from abcd_ns import RunOptions, TrainingConfig, UserError, View, train
from abcd_ns.cli.export import export
from abcd_ns.engine.events import StepTaken
from abcd_ns.nerfstudio.views import views_of
from tests.nerfstudio.crash_training import gaussians
from tests.nerfstudio.test_training import configure, run
from tests.reference.colmap_scene import write_scene
from tests.reference.scenes import equal, ring_of_views

README = Path(__file__).resolve().parents[2] / "README.md"
BEFORE = """
import sys
import abcd_ns
assert "torch" not in sys.modules
"""
AFTER = """
assert "nerfstudio" not in sys.modules
assert float((picture - photos[0] / 255).abs().mean()) < 0.02
"""


def test_the_lines_of_the_readme_train_and_render_without_nerfstudio(tmp_path):
    write_scene(tmp_path / "garden")
    (lines,) = re.findall(r"^```python\n(.*?)^```", README.read_text(), re.DOTALL | re.MULTILINE)
    command = [sys.executable, "-c", BEFORE + lines + AFTER]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "garden-view-0.png").exists()
    assert export(tmp_path / "garden-run", out=tmp_path / "garden.ply", frame="nerfstudio") == 0


def test_it_trains_as_ns_train_does(tmp_path):
    steps, heard = 24, []
    config = configure(write_scene(tmp_path / "wall"), tmp_path / "out", steps=steps)
    trainer = run(config)
    dataset = trainer.pipeline.datamanager.train_dataset
    photos = [dataset.photos.image(row) for row in range(len(dataset))]
    points = dataset.metadata["points3D_xyz"], dataset.metadata["points3D_rgb"]
    options = RunOptions(**{f.name: getattr(config.pipeline, f.name) for f in dataclasses.fields(RunOptions)})
    given = views_of(dataset.cameras), photos, points, tmp_path / "alone"
    found = train(*given, steps=steps, options=options, listener=heard.append)
    assert sum(isinstance(event, StepTaken) for event in heard) == steps
    assert found.near == trainer.pipeline.model.near
    expected = gaussians(trainer.base_dir)
    assert all(
        torch.equal(value, expected[f"_model.gauss_params.{name}"]) for name, value in found.gaussians.items()
    )


def multiplied(name: str, by: float) -> list[View]:
    """Views with another `K` or `viewmat`."""
    return [dataclasses.replace(view, **{name: by * getattr(view, name)}) for view in ring_of_views(2)]


def unchecked(**fields: object) -> RunOptions:
    """Options with fields of a run or of its training, which beartype would refuse elsewhere."""
    options = RunOptions()
    for name, value in fields.items():
        setattr(options if hasattr(options, name) else options.training, name, value)
    return options


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"photos": [torch.zeros(36, 48, 3)]}, "2 views and 1 photos"),
        ({"photos": [torch.zeros(36, 48, 3), torch.zeros(36, 48, 4)]}, "Photo 1 has shape"),
        ({"options": RunOptions(cluster="head:6379", workers=2)}, "need ns-train"),
        ({"options": RunOptions(training=TrainingConfig(warmup=2.0))}, "warmup"),
        ({"photos": [torch.full((36, 48, 3), 200.0)] * 2}, "Photo 0 has values from 200 to 200: give int"),
        ({"photos": [torch.full((36, 48, 3), True)] * 2}, "Photo 0 has values from 1 to 1: give int"),
        ({"photos": [torch.full((36, 48, 3), -1.0)] * 2}, "from -1 to -1"),
        ({"photos": [torch.full((36, 48, 3), torch.nan)] * 2}, "from nan"),
        ({"photos": [torch.full((36, 48, 3), 9_999, dtype=torch.uint16)] * 2}, "from 9999"),
        ({"points": (torch.rand(9, 3), torch.rand(9, 3))}, "scale them to 0..255"),
        ({"points": (torch.rand(9, 3), torch.full((9, 3), 65_535))}, "from 65535 to 65535"),
        ({"points": (torch.rand(9, 3), torch.full((9, 3), torch.nan))}, "from nan"),
        ({"points": (torch.rand(3, 9), torch.zeros(3, 9))}, re.escape("[3, 9] and [3, 9]")),
        *(({"views": multiplied("K", by)}, "K must be in pixels") for by in (0, 1 / 480)),
        *(({"views": multiplied("viewmat", by)}, "View 0 has a viewmat") for by in (torch.nan, 3)),
        ({"points": (torch.full((2, 3), torch.nan), torch.zeros(2, 3))}, "No point is finite"),
        ({"points": (torch.zeros(0, 3), torch.zeros(0, 3))}, "0 points and 0 colours"),
        ({"points": (torch.rand(9, 3), torch.zeros(8, 3))}, "9 points and 8 colours"),
        ({"options": unchecked(partition="oct")}, "'oct' - at `[$].partition`"),
        ({"options": unchecked(blocks=2.5)}, "`int`, got `float` - at `[$].blocks`"),
        ({"options": unchecked(light="gain")}, "'gain' - at `[$].training.light`"),
        ({"options": RunOptions(blocks=-1)}, "blocks must be 0 or more"),
        ({"options": RunOptions(blocks=65_537)}, "blocks must be 65536 or less"),
        ({"steps": 0}, "at least 1"),
        ({"options": RunOptions(max_seconds=0.0)}, "above 0"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(tmp_path, change, says):
    given = {
        "views": ring_of_views(2),
        "photos": [torch.zeros(36, 48, 3)] * 2,
        "points": (torch.rand(9, 3), torch.zeros(9, 3)),
        "steps": 1,
        **change,
    }
    with pytest.raises(UserError, match=says):
        train(out=tmp_path / "out", **given)
    assert not (tmp_path / "out").exists()


def test_photos_of_double_precision_and_arrays_train_as_tensors_of_single(tmp_path):
    """What numpy makes of a photo divided by 255."""
    views, points = ring_of_views(3), (torch.rand(9, 3) - 0.5, torch.zeros(9, 3))
    photos = [torch.rand(36, 48, 3, generator=torch.Generator().manual_seed(k)) for k in range(3)]
    single = train(views, photos, points, tmp_path / "single", steps=2)
    double = [photo.double() for photo in photos]
    arrays = [photo.numpy() for photo in photos], tuple(part.numpy() for part in points)
    for number, given in enumerate([(double, points), arrays]):
        again = train(views, *given, tmp_path / str(number), steps=2)
        assert equal(again.gaussians, single.gaussians)


def moved(view: View, away: torch.Tensor) -> View:
    viewmat = view.viewmat.double()
    viewmat[:3, 3] -= viewmat[:3, :3] @ away.double()
    return dataclasses.replace(view, viewmat=viewmat)


@pytest.mark.parametrize(("away", "warnings"), [(0.0, 0), (5e6, 1)])
def test_coordinates_that_single_precision_rounds_are_told_of(tmp_path, caplog, away, warnings):
    views = [moved(view, torch.full((3,), away)) for view in ring_of_views(2)]
    points = torch.rand(9, 3).double() - 0.5 + away, torch.zeros(9, 3)
    train(views, [torch.zeros(36, 48, 3)] * 2, points, tmp_path, steps=1)
    assert caplog.text.count("units from the origin, where float32 rounds to") == warnings
