"""Data that nerfstudio's own readers read: in this process, on a tiny scene."""

import io
import shlex
from pathlib import Path

import pytest
import torch
import yaml
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from abcd_ns.cli.mesh.command import mesh
from abcd_ns.cli.report.command import report
from abcd_ns.cli.report.page import training_command
from abcd_ns.cli.report.run_folder import load_pipeline, open_run
from abcd_ns.data.input_errors import InputError
from abcd_ns.nerfstudio.inspection import inspect
from abcd_ns.nerfstudio.model import AbcdModel
from abcd_ns.nerfstudio.trainer import AbcdTrainer
from tests.data.test_layouts import write_blender
from tests.nerfstudio.test_tools import evaluated
from tests.nerfstudio.test_training import configure, run


@pytest.fixture(scope="module")
def theirs(data, tmp_path_factory) -> AbcdTrainer:
    config = configure(data, tmp_path_factory.mktemp("theirs"), steps=8)
    config.pipeline.datamanager.dataparser = ColmapDataParserConfig(colmap_path=Path("sparse/0"))
    return run(config)


def test_a_scene_that_nerfstudios_colmap_reader_reads_trains_as_ours_does(data, theirs, tmp_path):
    ours = run(configure(data, tmp_path / "ours", steps=8))
    for name in ("train_dataset", "eval_dataset"):
        a, b = (getattr(trainer.pipeline.datamanager, name) for trainer in (theirs, ours))
        assert [p.name for p in a.image_filenames] == [p.name for p in b.image_filenames]
        assert torch.allclose(a.cameras.camera_to_worlds, b.cameras.camera_to_worlds, atol=1e-5)
    assert theirs.pipeline.coordinator.count() == pytest.approx(ours.pipeline.coordinator.count(), rel=0.1)
    config = yaml.load((theirs.base_dir / "config.yml").read_text(), Loader=yaml.Loader)
    assert isinstance(config.pipeline.datamanager.dataparser, ColmapDataParserConfig)
    assert "psnr" in evaluated(theirs.base_dir, tmp_path)
    found = open_run(theirs.base_dir)
    assert isinstance(load_pipeline(found, data).model, AbcdModel)
    again = shlex.split(training_command(found.settings).replace("\\\n", ""))
    assert again[again.index("colmap") :] == ["colmap", "--colmap-path", "sparse/0"]


def test_the_wrong_data_for_another_reader_is_one_line(theirs, tmp_path):
    found, out = open_run(theirs.base_dir), tmp_path / "new.ply"
    with pytest.raises(InputError, match=f"colmap cannot read {tmp_path}"):
        load_pipeline(found, tmp_path)
    assert report(theirs.base_dir, data=tmp_path, out=tmp_path / "page.html") == 0
    assert "colmap cannot read" in (tmp_path / "page.html").read_text()
    with pytest.raises(InputError, match=f"colmap cannot read {tmp_path}"):
        mesh(theirs.base_dir, data=tmp_path, out=out, frame="nerfstudio")
    assert not out.exists()


def test_a_scene_without_points_begins_at_random_and_says_so(tmp_path, capsys):
    config = configure(write_blender(tmp_path / "lego"), tmp_path / "out", steps=4, blocks=0)
    config.pipeline.datamanager.dataparser = BlenderDataParserConfig()
    config.pipeline.model.num_random = 300
    trainer = run(config)
    said = capsys.readouterr().out
    assert said.count("300 Gaussians begin at random places, as splatfacto's do") == 1
    assert 0 < trainer.pipeline.coordinator.count() <= 300  # some go at the end
    (trainer.pipeline.datamanager.config.data / "train" / "r_0.png").unlink()
    # Who only looks at a scene needs no photos; Blender's reader itself opens the first, for its size.
    Image.new("RGBA", (32, 24)).save(tmp_path / "lego" / "train" / "r_0.png")
    (tmp_path / "lego" / "train" / "r_1.png").unlink()
    eval_setup(trainer.base_dir / "config.yml", test_mode="inference")


def test_a_question_of_another_reader_without_a_terminal_is_one_line(data, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    parser = ColmapDataParserConfig(data=data, colmap_path=Path("sparse/0"), downscale_factor=2)
    with pytest.raises(InputError, match=r"colmap asks .* no terminal"):
        inspect(parser)
