"""Chart, table and pictures, from made-up runs."""

import dataclasses
from io import StringIO
from pathlib import Path

from PIL import Image
from rich.console import Console

from abcd_ns.lab.compare.charts import draw_charts
from abcd_ns.lab.compare.command import shown
from abcd_ns.lab.compare.pictures import draw_pictures
from abcd_ns.lab.job import METHODS, Job, Plan
from abcd_ns.lab.results.results import ViewScore
from abcd_ns.lab.results.style import COLORS, MARKERS
from abcd_ns.lab.results.tables import notes, print_rows, rows
from tests.lab.compare.records import made_up, made_up_arm, made_up_results, made_up_run, made_up_settings

# The charts


def counted(*counts: int, **fields):
    base = made_up_run(**fields)
    points = (dataclasses.replace(p, gaussians=n) for p, n in zip(base.curve, counts, strict=False))
    return dataclasses.replace(base, curve=tuple(points))


def test_charts_show_every_method_in_its_own_colour_with_units(tmp_path, drawn):
    runs = (counted(9, 90, 200 + i, method=method, psnr=20.0 + i) for i, method in enumerate(METHODS))
    paths = draw_charts(made_up_results(*runs), tmp_path)
    assert [path.name for path in paths] == ["speed_accuracy.png", "size_accuracy.png", "memory.png"]
    for name, axis in (("speed_accuracy", "training time (s)"), ("size_accuracy", "Gaussians in the scene")):
        texts = drawn[f"{name}.png"]
        for method in METHODS:
            assert sum(text.startswith(f"{method}  ") for text in texts) == 1
        assert any(text.startswith(axis) for text in texts)
        assert "held-out PSNR (dB)" in texts
    assert {"abcd, RAM", "peak memory (MiB)"} <= set(drawn["memory.png"])
    assert len(set(COLORS.values())) == len(set(MARKERS.values())) == len(METHODS)
    with Image.open(tmp_path / "speed_accuracy.png") as image:
        colours = {pixel for _, pixel in image.convert("RGB").getcolors(1 << 24)}
    assert all(tuple(bytes.fromhex(COLORS[method][1:])) in colours for method in METHODS)


def test_without_a_run_there_is_no_chart_and_without_counts_none_of_gaussians(tmp_path):
    assert draw_charts(made_up_results(), tmp_path) == []
    paths = draw_charts(made_up_results(counted(1, 2), made_up_run()), tmp_path)
    assert [path.name for path in paths] == ["speed_accuracy.png", "memory.png"]


# The table


def test_table_has_a_column_per_method_and_a_row_per_known_measure():
    lpips = {"lpips": 0.25}
    results = made_up_results(made_up_run("abcd-monolithic", psnr=25.0), made_up_run(psnr=24.0, **lpips))
    titles, *body = rows(results)
    assert titles == ["", "abcd-monolithic", "abcd"]
    table = {row[0]: row[1:] for row in body}
    assert table["PSNR, composited (dB)"] == ["24.90", "23.90"]
    assert table["Gaussians"] == ["12,345", "12,345"]
    assert table["LPIPS, composited"] == ["-", "0.250"]
    assert "peak GPU memory (GiB)" not in table
    assert table["peak RAM (GiB)"] == ["1.50", "1.50"]
    assert table["blocks on disk (MiB)"] == ["256.0", "256.0"]
    wanted = "PSNR SSIM LPIPS merged gap Gaussians steps training layers process RAM disk"
    assert all(any(word in title for title in table) for word in wanted.split())


def test_changes_have_their_difference_to_the_method_as_it_is_seed_by_seed():
    default = made_up_arm("default", {0: 20.0, 1: 24.0, 2: 9.0})
    other = made_up_arm("training.batch=1", {0: 21.0, 1: 25.5})
    results = made_up("comparison", default, other, seeds=(0, 1, 2))
    (differences,) = (row for row in rows(results) if row[0] == "difference (dB)")
    assert differences == ["difference (dB)", "-", "+1.25 ± 0.35"]
    assert any("seed by seed" in note for note in notes(results))
    assert not any(row[0] == "difference (dB)" for row in rows(made_up("comparison", default)))
    names = ("blocks=1", "blocks=1 training.batch=1", "blocks=8", "blocks=8 training.batch=1")
    results = made_up("comparison", *(made_up_arm(name, {0: 20.0}) for name in names))
    bases = [base and base.variant for base in map(results.baseline, results.arms)]
    assert bases == [None, "blocks=1", None, "blocks=8"]
    varied = [made_up_arm(name, {0: 20.0}) for name in ("default", "partition=grid blocks=27")]
    assert made_up("comparison", *varied).baseline(varied[1]) is varied[0]


def test_the_worst_view_is_held_against_the_same_of_one_block():
    def run(method, *psnrs):
        views = (ViewScore(k, f"{k}.png", p, None, None, p, None) for k, p in enumerate(psnrs))
        return made_up_run(method, views=tuple(views))

    joint, blocks = run("abcd-monolithic", 20.0, 30.0), run("abcd", 20.5, 28.0)
    results = made_up_results(joint, blocks)
    assert ["worst view (dB)", "-", "-2.00"] in rows(results)
    assert any("Worst view" in note for note in notes(results))
    assert not any("worst view (dB)" in row for row in rows(made_up_results(blocks)))


def test_a_method_with_several_arms_has_its_best_and_worst_and_the_fewest_gaussians_said():
    sizes = {"blocks=1": (25.0, 9000), "blocks=2": (24.9, 4000), "blocks=27": (24.4, 2000)}
    arms = [made_up_arm(n, {0: psnr}, gaussians=count) for n, (psnr, count) in sizes.items()]
    (finding,) = made_up("comparison", *arms, made_up_arm("default", {0: 9.0}, "splatfacto")).findings
    for part in (
        "Best: abcd, 1 block, 25.00 dB.",
        "Worst: abcd, 27 blocks, 24.40 dB.",
        "Gap: 0.60 dB.",
        "within 0.2 dB of the best: 4,000 (abcd, 2 blocks, 24.90 dB)",
    ):
        assert part in finding
    assert made_up("comparison", arms[0]).findings == ()


def test_terminal_shows_whole_numbers_however_narrow_it_is():
    results = made_up_results(*(made_up_run(m, s) for m in METHODS for s in (0, 1)), seeds=(0, 1))
    stream = StringIO()
    console = Console(file=stream, width=60)
    print_rows(rows(results), notes(results), console)
    assert "…" not in stream.getvalue()
    assert all(method in stream.getvalue() for method in METHODS)
    assert console.width == 60


def test_runs_of_several_versions_are_told():
    old = made_up_run("abcd-monolithic")
    old = dataclasses.replace(old, versions=dataclasses.replace(old.versions, commit="0123456789"))
    assert any("several versions" in line for line in notes(made_up_results(made_up_run(), old)))
    assert not any("several versions" in line for line in notes(made_up_results(made_up_run())))


# Pictures


def test_every_view_that_all_runs_drew_gets_a_figure_of_photo_and_pictures(tmp_path):
    views = tuple(ViewScore(row, f"{row:04d}.jpg", 1.0, None, None, 1.0, None) for row in (0, 5))
    colours = {("abcd-monolithic", "photo"): (10, 200, 30), ("abcd-monolithic", "merged"): (200, 30, 40)}
    colours |= {("abcd", "photo"): (10, 200, 30), ("abcd", "merged"): (200, 30, 41)}
    runs = [(m, made_up_run(m, views=views), tmp_path / m) for m in ("abcd-monolithic", "abcd")]
    for (method, kind), colour in colours.items():
        (tmp_path / method).mkdir(exist_ok=True)
        for row in (0, 5):
            Image.new("RGB", (32, 24), colour).save(tmp_path / method / f"{kind}-{row:04d}.png")
    paths = draw_pictures(runs, tmp_path / "pictures")
    assert [path.name for path in paths] == ["view-0000.png", "view-0005.png"]
    with Image.open(paths[0]) as image:
        counts = {pixel: n for n, pixel in image.convert("RGB").getcolors(1 << 24)}
    assert all(counts[colour] > 10_000 for colour in colours.values())
    assert draw_pictures([], tmp_path / "nothing") == []


def test_where_a_seed_failed_pictures_are_of_one_that_all_methods_have_and_titles_count_what_is_there():
    runs = [made_up_run(seed=0), made_up_run(seed=1), made_up_run("abcd-monolithic", seed=1)]
    results = made_up_results(*runs, seeds=(0, 1))
    jobs = tuple(Job(run.method, run.seed, results.settings) for run in runs)
    plan = Plan("comparison", results.settings, Path("out"), jobs, "abcd")
    found = [(label, run.seed, folder) for label, run, folder in shown(results, plan)]
    assert found == [(m, 1, Path(f"out/runs/{m}/seed-1/pictures")) for m in ("abcd", "abcd-monolithic")]
    assert results.means_of == "mean of 1 to 2 seeds"
    assert made_up_results(made_up_run()).means_of == ""


def test_within_budgets_pictures_are_of_the_smallest_beside_what_no_limit_gives():
    asked = {"abcd-monolithic": [(), ("gaussian_bytes=4194304",), ("gaussian_bytes=2097152",)]}
    asked["abcd"] = asked["abcd-monolithic"][1:]
    jobs = tuple(Job(m, 0, made_up_settings(), changes) for m, arms in asked.items() for changes in arms)
    results = made_up("comparison", *(made_up_arm(j.variant, {0: 24.0}, j.method) for j in jobs))
    found = shown(results, Plan("comparison", results.settings, Path("out"), jobs, "abcd"))
    assert [label for label, _, _ in found] == ["abcd-monolithic", "abcd-monolithic, 2 MiB", "abcd, 2 MiB"]
    assert len({folder for _, _, folder in found}) == 3
