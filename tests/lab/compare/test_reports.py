"""Chart, table and pictures, from made-up runs."""

import dataclasses
import re
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rich.console import Console

from abcd_ns.engine.train.schedule import evenly
from abcd_ns.lab.compare.charts import draw_size_accuracy, draw_speed_accuracy, mean_curve
from abcd_ns.lab.compare.command import first_runs
from abcd_ns.lab.compare.pictures import draw_comparison, draw_pictures, error_map, psnr_of
from abcd_ns.lab.job import METHODS
from abcd_ns.lab.results.results import Arm
from abcd_ns.lab.results.run import ViewScore
from abcd_ns.lab.results.style import COLORS, MARKERS, spread
from abcd_ns.lab.results.tables import MEASURES, cell, notes, print_table, rows, write_table
from tests.lab.compare.records import made_up, made_up_results, made_up_run
from tests.lab.svg import texts_of

# The chart


def test_chart_shows_every_method_in_its_own_colour_with_units(tmp_path):
    results = made_up_results(*(made_up_run(method, psnr=20.0 + i) for i, method in enumerate(METHODS)))

    paths = draw_speed_accuracy(results, tmp_path)

    assert sorted(path.name for path in paths) == ["speed_accuracy.png", "speed_accuracy.svg"]
    texts = texts_of(tmp_path / "speed_accuracy.svg")
    for method in METHODS:
        assert sum(text.startswith(f"{method}  ") for text in texts) == 1
    assert {"training time (s)", "held-out PSNR (dB)"} <= set(texts)
    source = (tmp_path / "speed_accuracy.svg").read_text().lower()
    assert all(COLORS[method].lower() in source for method in METHODS)
    assert len(set(COLORS.values())) == len(set(MARKERS.values())) == len(METHODS)
    with Image.open(tmp_path / "speed_accuracy.png") as image:
        colours = {pixel for _, pixel in image.convert("RGB").getcolors(1 << 24)}
    assert all(tuple(bytes.fromhex(COLORS[method][1:])) in colours for method in METHODS)


def test_chart_is_the_same_file_every_time(tmp_path):
    results = made_up_results(made_up_run(), made_up_run("abcd-monolithic"))
    drawn = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        draw_speed_accuracy(results, tmp_path / name)
        drawn.append((tmp_path / name / "speed_accuracy.svg").read_bytes())
    assert drawn[0] == drawn[1]


def test_no_run_no_chart(tmp_path):
    assert draw_speed_accuracy(made_up_results(), tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def counted(*counts: int, **fields):
    """A run whose curve holds these numbers of Gaussians."""
    base = made_up_run(**fields)
    curve = base.curve[: len(counts)]
    points = [dataclasses.replace(p, gaussians=n) for p, n in zip(curve, counts, strict=True)]
    return dataclasses.replace(base, curve=tuple(points))


def test_the_way_through_numbers_of_gaussians_has_a_chart(tmp_path):
    results = made_up_results(counted(100, 900, 2000), counted(100, 500, 800, method="abcd-monolithic"))
    paths = draw_size_accuracy(results, tmp_path)
    assert [path.name for path in paths] == ["size_accuracy.png", "size_accuracy.svg"]
    texts = texts_of(paths[1])
    assert {"held-out PSNR (dB)", "2,000"} <= set(texts)
    assert any(text.startswith("Gaussians in the scene") for text in texts)


def test_runs_that_counted_no_gaussians_have_no_such_chart(tmp_path):
    assert draw_size_accuracy(made_up_results(counted(1, 2), made_up_run()), tmp_path) == []
    assert draw_size_accuracy(made_up_results(), tmp_path) == []


def test_mean_curve_is_the_mean_of_seeds_and_keeps_every_end():
    one, other = made_up_run(psnr=20.0), made_up_run(psnr=22.0, seed=1)
    short = made_up_run(psnr=22.0, seed=1, curve=(*other.curve[:2], other.curve[-1]))
    points = mean_curve([one, other])
    assert [psnr for _, psnr in points] == pytest.approx([point.psnr + 1 for point in one.curve])
    assert [seconds for seconds, _ in points] == pytest.approx([point.seconds for point in one.curve])
    assert len(mean_curve([one, short])) == 3
    assert mean_curve([one, short])[-1] == pytest.approx(points[-1])


@given(st.lists(st.floats(0, 10), min_size=1, max_size=6))
def test_labels_keep_their_distance_and_their_order(wanted):
    placed = spread(wanted, 0.5)
    order = np.argsort(wanted, kind="stable")
    gaps = np.diff(np.asarray(placed)[order])
    assert (gaps > 0.5 - 1e-3).all()
    assert np.mean(placed) == pytest.approx(np.mean(wanted), abs=1e-6)


# The table


def test_table_has_a_column_per_method_and_a_row_per_measure(tmp_path):
    results = made_up_results(made_up_run("abcd-monolithic", psnr=25.0), made_up_run(psnr=24.0))
    titles, *body = rows(results)
    assert titles == ["", "abcd-monolithic", "abcd"]
    table = {row[0]: row[1:] for row in body}
    assert table["PSNR, composited (dB)"] == ["24.90", "23.90"]
    assert table["Gaussians"] == ["12,345", "12,345"]
    assert table["LPIPS, composited"] == ["-", "-"]
    assert table["peak RAM (GiB)"] == ["1.50", "1.50"]
    assert table["blocks on disk (MiB)"] == ["256.0", "256.0"]
    wanted = "PSNR SSIM LPIPS merged gap Gaussians steps training layers process GPU RAM disk"
    assert all(any(word in title for title in table) for word in wanted.split())

    write_table(results, tmp_path / "table.md")
    lines = (tmp_path / "table.md").read_text().splitlines()
    widths = {line.count("|") for line in lines if line.startswith("|")}
    assert widths == {4}
    assert len([line for line in lines if line.startswith("|")]) == 2 + len(MEASURES)


def test_table_has_a_column_for_each_way_that_a_method_is_set():
    arms = [("abcd-monolithic", "default"), ("abcd", "default"), ("abcd", "blocks=2")]
    titles, *body = rows(made_up("comparison", *(Arm(*arm, None, (made_up_run(arm[0]),)) for arm in arms)))
    assert titles == ["", "abcd-monolithic", "abcd", "abcd blocks=2"]
    assert {len(row) for row in body} == {len(titles)}


def test_several_seeds_give_mean_and_deviation():
    psnr = next(measure for measure in MEASURES if measure.title.startswith("PSNR, composited"))
    runs = [made_up_run(seed=seed, psnr=value + 0.1) for seed, value in enumerate((20.0, 22.0, 24.0))]
    assert cell(runs, psnr) == "22.00 ± 2.00"
    assert cell(runs[:1], psnr) == "20.00"


def test_terminal_shows_whole_numbers_however_narrow_it_is():
    results = made_up_results(*(made_up_run(m, s) for m in METHODS for s in (0, 1)), seeds=(0, 1))
    stream = StringIO()
    console = Console(file=stream, width=60)
    print_table(results, console)
    assert "…" not in stream.getvalue()
    assert all(method in stream.getvalue() for method in METHODS)
    assert console.width == 60


def test_notes_say_what_is_missing_and_why():
    single = made_up_run("abcd-monolithic", ordering_gap_db=None, ordering_gap_note="one block")
    text = "\n".join(notes(made_up_results(single)))
    for part in (
        "no weights",
        "no CUDA device",
        "splatfacto is left out: it needs a CUDA device",
        "abcd-ablated, seed 0 failed (runs/abcd-ablated/seed-0/log.txt): it broke",
        "abcd-monolithic: no ordering gap (one block)",
        "60 s of training a run, seed 0",
    ):
        assert part in text


# Pictures


def test_errors_are_absolute_differences():
    photo = np.zeros((2, 3, 3), np.uint8)
    picture = photo.copy()
    picture[0, 0] = (255, 0, 0)
    picture[1, 2] = (51, 51, 51)
    expected = np.array([[1 / 3, 0, 0], [0, 0, 0.2]])
    assert error_map(picture, photo) == pytest.approx(expected)
    assert error_map(photo, picture) == pytest.approx(expected)
    assert psnr_of(photo + np.uint8(51), photo) == pytest.approx(-20 * np.log10(0.2))
    assert psnr_of(photo, photo) == float("inf")


@given(st.integers(1, 200), st.integers(1, 10))
def test_shown_views_are_evenly_chosen(count, wanted):
    chosen = evenly(range(count), wanted)
    assert len(chosen) == len(set(chosen)) == min(count, wanted)
    assert 0 <= chosen[0] <= chosen[-1] < count
    gaps = np.diff([-chosen[0] - 1, *chosen, 2 * count - chosen[-1] - 1])  # mirrored at both ends
    assert gaps.max() - gaps.min() <= 2


def test_no_view_is_shown_where_none_is_wanted():
    assert evenly(range(5), 0) == []


@pytest.mark.parametrize("methods", [1, 3])
def test_a_figure_shows_photo_and_pictures_as_they_are(tmp_path, methods):
    photo = np.full((24, 32, 3), (10, 200, 30), np.uint8)
    shades = [(200, 30, 40 + i) for i in range(methods)]
    pictures = {f"method-{i}": np.full_like(photo, shade) for i, shade in enumerate(shades)}
    draw_comparison(photo, pictures, "a title", tmp_path / "figure.png")
    with Image.open(tmp_path / "figure.png") as image:
        counts = {pixel: n for n, pixel in image.convert("RGB").getcolors(1 << 24)}
    for colour in [(10, 200, 30), *shades]:
        assert counts[colour] > 10_000


def test_every_view_that_all_runs_drew_gets_a_figure(tmp_path):
    views = tuple(ViewScore(row, f"{row:04d}.jpg", 1.0, None, None, 1.0, None) for row in (0, 5))
    runs = []
    for method in ("abcd-monolithic", "abcd"):
        folder = tmp_path / method
        folder.mkdir()
        for row in (0, 5):
            for kind in ("photo", "merged"):
                Image.new("RGB", (32, 24), (row * 10, 0, 0)).save(folder / f"{kind}-{row:04d}.png")
        runs.append((made_up_run(method, views=views), folder))
    paths = draw_pictures(runs, tmp_path / "pictures")
    assert [path.name for path in paths] == ["view-0000.png", "view-0005.png"]
    assert all(re.match(rb"\x89PNG", path.read_bytes()) for path in paths)
    assert draw_pictures([], tmp_path / "nothing") == []


def test_where_a_seed_failed_pictures_are_of_one_that_all_methods_have_and_titles_count_what_is_there():
    results = made_up_results(
        *(made_up_run(seed=seed) for seed in (0, 1)), made_up_run("abcd-monolithic", seed=1), seeds=(0, 1)
    )
    plan = SimpleNamespace(settings=results.settings, out=Path("out"))
    assert [(run.method, run.seed) for run, _ in first_runs(results, plan)] == [
        ("abcd", 1),
        ("abcd-monolithic", 1),
    ]
    assert results.means_of == "mean of 1 to 2 seeds"
    assert made_up_results(made_up_run()).means_of == ""
