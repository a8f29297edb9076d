"""`abcd report` on runs that were really trained, whole and damaged ones."""

import io
import json
import os
import pickle
import re
import shutil
from contextlib import redirect_stdout
from pathlib import Path

import pytest
import torch

from abcd_ns import methods
from abcd_ns.cli import main as cli
from abcd_ns.cli.report.command import report
from abcd_ns.cli.report.run_folder import load_pipeline, open_run
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.run.log_lines import layer_share
from abcd_ns.nerfstudio.run.run_log import LOG_FILE
from abcd_ns.run import SETTINGS_FILE
from tests.nerfstudio.test_training import configure, run
from tests.reference.colmap_scene import HEIGHT, HELD_OUT, WIDTH, write_scene


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """The folder of a run, with its data beside it, and above it what the terminal said."""
    place = tmp_path_factory.mktemp("place")
    with redirect_stdout(io.StringIO()) as said:
        trainer = run(configure(write_scene(place / "wall"), place / "out"))
    (place / "said.txt").write_text(said.getvalue())
    return Path(trainer.base_dir)


def photos_of(trained: Path) -> Path:
    return trained.parents[3] / "wall"


@pytest.fixture
def copied(trained, tmp_path) -> Path:
    """The run again, to be damaged."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def settings_changed(folder: Path, **changes) -> None:
    """The run's settings, as someone else may have written them."""
    path = folder / "abcd" / SETTINGS_FILE
    settings = json.loads(path.read_text())
    options = settings["options"] | changes.pop("options", {})
    path.write_text(json.dumps(settings | changes | {"options": options}))


class Canary:
    """Unpickled, or made by an unsafe yaml loader, it leaves a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def test_a_run_becomes_one_page_that_tells_what_terminal_and_log_tell(trained, copied, capsys):
    data = ["--data", str(photos_of(trained))]
    assert cli.main(["report", str(copied / "config.yml"), *data, "--pictures", "0"]) == 0
    assert "<input" not in (copied / "report.html").read_text()
    assert cli.main(["report", str(copied), *data, "--pictures", "2"]) == 0  # over its own page
    page = (copied / "report.html").read_text()
    assert str(copied / "report.html") in capsys.readouterr().out
    assert page.count('type="range"') == 3
    assert len(re.findall(r'src="data:image/png', page)) == 8
    assert len(re.findall(r"<tr><td>\d</td>", page)) == 3
    assert "--max-num-iterations 36" in page
    assert f"Of {HELD_OUT} held-out views" in page
    assert len(page) < 1 << 20
    said, opened = (trained.parents[3] / "said.txt").read_text(), open_run(trained)
    story = opened.story
    summary = (
        r"Trained (\d+) steps .* held-out PSNR ([\d.]+) dB, ([\d,]+) Gaussians, (\d+%) of the time for layers"
    )
    step, psnr, gaussians, share = re.search(summary, said).groups()
    assert f"{HELD_OUT} held out; photos of up to {WIDTH} x {HEIGHT} px." in said
    assert opened.checkpoint.step == story.end.step == int(step) == 36
    assert psnr == f"{story.held_out[-1].psnr:.2f}"
    assert (gaussians, share) == (f"{story.gaussians:,}", f"{layer_share(story.visits):.0%}")
    for value in (f"{psnr} dB", f"{step} steps, {share} of the time for layers", gaussians):
        assert value in page


def test_no_object_is_made_of_what_a_folder_says(copied, tmp_path):
    bait = f"!!python/object/apply:os.mkdir ['{tmp_path / 'yaml'}']"
    (copied / "config.yml").write_text(bait)
    report(copied, pictures=0)
    checkpoint = next((copied / "nerfstudio_models").iterdir())
    content = {"step": 35, "pipeline": Canary(tmp_path / "pickle")}
    for save in (torch.save, lambda content, path: path.write_bytes(pickle.dumps(content))):
        save(content, checkpoint)
        with pytest.raises(UserError, match=r"step-000000035\.ckpt cannot be read"):
            report(copied)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]


def test_where_the_photos_are_gone_or_others_the_page_says_so_and_has_the_rest(copied, tmp_path, capsys):
    others = write_scene(tmp_path / "other")
    (others / "test_list.txt").write_text("01.png")
    for data, said in ((Path("/absent/wall"), "/absent/wall"), (others, "are not those that")):
        assert report(copied, data=data) == 0
        assert said in capsys.readouterr().out
        page = (copied / "report.html").read_text()
        assert "Held-out views could not be drawn" in page
        assert "Map of the blocks" in page
        assert "<input" not in page


def test_photos_are_those_of_a_folder_that_the_user_names(trained, copied, tmp_path, capsys):
    """Not of one that the run names: it may come from elsewhere, and the page may be handed on."""
    photos = photos_of(trained)
    assert report(copied) == 0
    page = (copied / "report.html").read_text()
    assert "<input" not in page
    assert f"--data {photos}" in capsys.readouterr().out.replace("\n", " ")
    # The run cannot lead out of the folder that is named, either.
    secret = shutil.copytree(photos, tmp_path / "secret")
    for value in (str(secret), "../secret"):
        options = {"pipeline.datamanager.dataparser.images_path": value}
        settings_changed(copied, data_path=str(secret), options=options)
        opened = open_run(copied)
        with pytest.raises(UserError, match=r"images_path is .*secret, outside of .*nothing there is read"):
            load_pipeline(opened, photos)


def test_nothing_that_a_run_says_steers_the_terminal(trained, copied, capsys):
    """An escape sequence could hide or fake what is printed; a newline as well."""
    hostile, shown = "x\x1b[2J\nerror", r"x\x1b[2J\nerror"
    versions = json.loads((copied / "abcd" / SETTINGS_FILE).read_text())["versions"] | {"abcd_ns": hostile}
    settings_changed(copied, versions=versions, data_path=hostile)
    assert report(copied) == 0
    said = capsys.readouterr().out
    assert said.count(shown) == 2
    assert "\x1b[2J" not in said
    images_path = "pipeline.datamanager.dataparser.images_path"
    for changes in (
        {"options": {images_path: f"../{hostile}"}},
        {"options": {images_path: f"{hostile}\0"}},
        {"options": {f"pipeline.{hostile}": 1}},
        {"options": {"pipeline.training.batch": hostile}},
        {"reader": hostile},
    ):
        shutil.copy(trained / "abcd" / SETTINGS_FILE, copied / "abcd" / SETTINGS_FILE)
        settings_changed(copied, versions=versions, **changes)
        opened = open_run(copied)
        with pytest.raises(UserError) as refused:
            load_pipeline(opened, photos_of(trained))
        assert str(refused.value).isprintable()
        assert shown in str(refused.value)
    settings_changed(copied, options={"pipeline.training.magic": 1}, reader="abcd-data")
    with pytest.raises(UserError, match=r"\(written by abcd_ns .*\): there is no option 'training.magic'"):
        load_pipeline(open_run(copied), Path("wall"))


def test_a_run_that_is_still_going_on_has_a_page(copied):
    shutil.rmtree(copied / "nerfstudio_models")
    log = copied / "abcd" / LOG_FILE
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[: len(lines) // 2]) + '{"kind": "sam')
    assert report(copied) == 0
    page = (copied / "report.html").read_text()
    assert "There is no checkpoint yet" in page
    assert "not ended" in page


@pytest.mark.parametrize(
    ("damaged", "content", "message"),
    [
        ("abcd/log.jsonl", None, r"log\.jsonl does not exist"),
        ("nerfstudio_models/*.ckpt", "", r"\.ckpt cannot be read"),
        ("abcd/store/manifest.json", "{}", r"manifest\.json is not the manifest"),
    ],
)
def test_what_is_damaged_is_named_and_nothing_is_written(copied, damaged, content, message):
    (path,) = copied.glob(damaged)
    path.unlink()
    if content is not None:
        path.write_text(content)
    with pytest.raises(UserError, match=message):
        report(copied)
    assert not (copied / "report.html").exists()


def test_a_folder_above_the_run_gets_a_hint(trained):
    for place in (trained.parent, trained.parents[2], trained / "nerfstudio_models"):
        with pytest.raises(UserError, match=f"did you mean {trained}"):
            report(place)


def test_files_of_something_else_are_left_alone(trained, tmp_path):
    mine = tmp_path / "thesis.html"
    mine.write_text("<p>mine</p>")
    with pytest.raises(UserError, match="is no page of this command"):
        report(trained, out=mine)
    assert mine.read_text() == "<p>mine</p>"
    with pytest.raises(UserError, match="is a folder"):
        report(trained, out=tmp_path)
    with pytest.raises(UserError, match="--pictures is -1"):
        report(trained, pictures=-1)


@pytest.mark.parametrize("method", [methods.abcd_monolithic, methods.abcd_exact])
def test_every_way_to_train_has_a_page(tmp_path, method):
    photos = write_scene(tmp_path / "wall")
    trainer = run(configure(photos, tmp_path / "out", method, steps=8))
    assert report(Path(trainer.base_dir), data=photos, pictures=1) == 0
    page = (Path(trainer.base_dir) / "report.html").read_text()
    assert ("ordering gap" in page) == (method is not methods.abcd_monolithic)
    assert ("trained in every step" in page) == (method is methods.abcd_exact)
