"""A run that begins with the Gaussians of a .ply file: `--pipeline.model.init-splats`."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from abcd_ns.cli.export import export
from abcd_ns.data.ply import read_gaussians
from abcd_ns.engine.types import PARAM_NAMES
from abcd_ns.formats.ply import Content, columns, pieces
from tests.nerfstudio.crash_training import assert_same, gaussians
from tests.nerfstudio.test_training import configure, run
from tests.reference.scenes import random_gaussians


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory) -> tuple[dict[str, torch.Tensor], Path]:
    """A short run's scene, and its file in the frame of the poses."""
    folder = tmp_path_factory.mktemp("trained")
    found, file = run(configure(data, folder, steps=6)), folder / "scene.ply"
    export(found.base_dir, out=file)
    return sorted_rows(gaussians(found.base_dir)), file


def write_ply(path: Path, *content, **options) -> None:
    path.write_bytes(b"".join(pieces(Content(*content, **options))))


def sorted_rows(scene: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """By name of the parameter; Gaussians by their places."""
    values = {name.rpartition(".")[2]: value for name, value in scene.items()}
    values["quats"] = torch.nn.functional.normalize(values["quats"], dim=1)
    order = (values["means"] @ torch.tensor([1.0, 2.0, 3.0])).argsort()
    return {name: value[order] for name, value in values.items()}


def start_from(file: Path, data: Path, out: Path, blocks: int = 3, steps: int = 1):
    config = configure(data, out, steps=steps, blocks=blocks)
    config.pipeline.model.init_splats = file
    return config


def test_a_run_begins_where_the_file_ended(data, trained, tmp_path):
    expected, file = trained
    config = start_from(file, data, tmp_path)
    config.pipeline.training.density.strategy = "off"
    for group in config.optimizers.values():
        group["optimizer"].lr = 0.0
    found = sorted_rows(gaussians(run(config).base_dir))
    signs = (found["quats"] * expected["quats"]).sum(dim=1, keepdim=True).sign()
    found["quats"] = found["quats"] * signs
    for name in PARAM_NAMES:
        assert torch.allclose(found[name], expected[name], atol=2e-5), name


def test_it_learns_grows_and_resumes(data, trained, tmp_path):
    """By steps of four views from the first on, as trained blocks; one that begins with points draws one."""
    (_, file), batches = trained, set()
    begin = start_from(file, data, tmp_path, steps=40)
    first = run(begin, 25, lambda trainer: batches.add(trainer.pipeline.coordinator.batch))
    assert batches == {4}
    config = start_from(tmp_path / "gone.ply", data, tmp_path / "more", steps=40)
    config.load_dir = first.checkpoint_dir
    whole, resumed = run(start_from(file, data, tmp_path / "whole", steps=40)), run(config)
    assert_same(resumed.base_dir, whole.base_dir)


def test_what_writers_put_down_is_read(tmp_path):
    written = random_gaussians(5, sh_degree=2)
    written.opacities[0] = torch.inf  # quite opaque
    written.scales[1, 2] = -torch.inf  # flat
    written.means[2, 0], written.quats[3] = torch.nan, 0.0
    file = tmp_path / "scene.ply"
    write_ply(file, 5, 2, [written])
    found, lost = read_gaussians(file)
    assert lost == 2
    assert found.sh_degree == 2
    assert torch.equal(found.means, written.means[[0, 1, 4]])
    assert torch.equal(found.features_rest, written.features_rest[[0, 1, 4]])
    assert float(found.opacities[0].sigmoid()) == pytest.approx(1)
    assert float(found.scales[1, 2].exp()) == pytest.approx(0, abs=1e-8)


def test_a_file_in_another_frame_is_refused(data, trained, tmp_path, said_at_exit):
    """nerfstudio's own is the one in which `ns-export` writes."""
    _, file = trained
    run_folder = file.parent / "wall" / "abcd" / "run"
    moved, far = tmp_path / "moved.ply", tmp_path / "far.ply"
    export(run_folder, out=moved, frame="nerfstudio")
    found, _ = read_gaussians(file)
    write_ply(far, len(found), found.sh_degree, [replace(found, means=found.means + 1000)])
    for path, reason in ((moved, "is in nerfstudio's frame"), (far, "lies elsewhere")):
        assert reason in said_at_exit(run, start_from(path, data, tmp_path / "out"))


def test_what_is_no_number_is_left_out_and_told_and_an_antialiased_file_asks_for_the_option(
    data, trained, tmp_path, capsys
):
    found, _ = read_gaussians(trained[1])
    found.means[0] = torch.nan
    file = tmp_path / "scene.ply"
    write_ply(file, len(found), found.sh_degree, [found], antialiased=True)
    run(start_from(file, data, tmp_path / "out"))
    said = " ".join(capsys.readouterr().out.split())
    assert "1 others hold NaN" in said
    assert "--pipeline.training.antialiased True: add that" in said


def write_columns(file: Path, *names: str) -> None:
    """A .ply file with these columns, and no row."""
    head = "".join(f"property float {name}\n" for name in names)
    file.write_text(f"ply\nformat ascii 1.0\nelement vertex 0\n{head}end_header\n")


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (lambda _: None, "does not exist"),
        (Path.mkdir, "is a folder"),
        (lambda file: write_ply(file, 0, 0, []), "has no Gaussians"),
        (lambda file: write_columns(file, "x", "y", "z"), "lacks scale_0"),
        (lambda file: write_columns(file, *columns(0), "f_rest_0", "f_rest_1"), "has 2 harmonics f_rest"),
        (lambda file: file.write_bytes(b""), "is not a .ply file"),  # others: tests/data/test_ply.py
        (lambda file: write_ply(file, 5, 0, [random_gaussians(5, sh_degree=0)]), "max-gaussians is 3"),
    ],
)
def test_other_files_are_refused_in_one_line(data, tmp_path, said_at_exit, write, reason):
    file = tmp_path / "scene.ply"
    write(file)
    config = start_from(file, data, tmp_path / "out")
    config.pipeline.training.density.max_gaussians = 3
    lines = said_at_exit(run, config).splitlines()
    assert any(str(file) in line and reason in line for line in lines)
    assert not (tmp_path / "out").exists()
