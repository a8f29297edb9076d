"""What a study says of its runs: findings, table, chart; and runs that are reused or fail."""

from io import StringIO

import pytest
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.job import Plan
from abcd_ns.lab.results.findings import best_and_worst, find_difference
from abcd_ns.lab.results.frontier import LIMIT, MCMC, PRICE, curves, fewest_near_best, psnr_at
from abcd_ns.lab.results.records import encode, write_json
from abcd_ns.lab.results.results import Arm
from abcd_ns.lab.results.tables import notes, rows, write_table
from abcd_ns.lab.study.charts import draw_study
from abcd_ns.lab.study.command import BlocksStudy, OptionsStudy, carry_out
from tests.lab.compare.records import read_results
from tests.lab.in_process import jobs_in_this_process
from tests.lab.study.records import (
    blocks_study,
    gaussians_study,
    made_up_arm,
    made_up_study,
    options_study,
)
from tests.lab.svg import texts_of

STUDIES = [blocks_study, gaussians_study, options_study]


def arms(psnrs: dict[int, float], method: str = "abcd"):
    return [made_up_arm(f"x={value}", value, {0: psnr}, method) for value, psnr in psnrs.items()]


# Findings


def test_the_gap_is_between_best_and_worst():
    best, worst = best_and_worst(arms({1: 24.0, 2: 25.0, 4: 24.7}))
    assert (best.value, worst.value) == (2, 1)
    assert best_and_worst(arms({1: 24.0})) is None


@pytest.mark.parametrize(("worst", "verdict"), [(24.6, "within the 0.5 dB"), (24.4, "above the 0.5 dB")])
def test_a_study_of_blocks_says_whether_the_goal_is_met(worst, verdict):
    (finding,) = made_up_study("blocks", *arms({1: 25.0, 27: worst})).findings
    assert verdict in finding
    assert finding.startswith(f"Best: 1 block, 25.00 dB. Worst: 27 blocks, {worst:.2f} dB.")


def frontier_arm(variant: str, gaussians: int, psnr: float) -> Arm:
    return made_up_arm(variant, None, {0: psnr}, gaussians=gaussians)


@pytest.mark.parametrize(("near", "fewest"), [(24.9, 4000), (24.79, 9000)])
def test_the_fewest_gaussians_near_the_best_may_be_on_any_curve(near, fewest):
    arms = [frontier_arm("default", 9000, 24.95), frontier_arm("training.density.price=1", 20_000, 25.0)]
    arms.append(frontier_arm("training.density.max_gaussians=4000", 4000, near))
    assert fewest_near_best(arms).gaussians == fewest


def test_other_ways_are_read_at_the_number_that_the_method_comes_to_by_itself():
    mcmc = "training.density.strategy=mcmc training.density.max_gaussians="
    study = made_up_study(
        "gaussians",
        frontier_arm("default", 4000, 25.0),
        frontier_arm(f"{mcmc}2000", 2000, 22.0),
        frontier_arm(f"{mcmc}8000", 8000, 24.0),
        frontier_arm("training.density.max_gaussians=2000", 2000, 21.0),
    )
    assert list(curves(study)) == [PRICE, LIMIT, MCMC]
    own, fewest, other = study.findings  # the only limit says nothing about 4,000
    assert own == "As it is, abcd comes to 4,000 Gaussians and 25.00 dB."
    assert "are 4,000 (as it is: 25.00 dB)" in fewest
    assert other == "MCMC, with as many Gaussians as the method as it is: 23.00 dB (-2.00)."
    assert psnr_at(curves(study)[MCMC], 9000) is None


def test_differences_are_taken_seed_by_seed():
    default = made_up_arm("default", None, {0: 20.0, 1: 24.0, 2: 9.0})
    other = made_up_arm("training.batch=1", None, {0: 21.0, 1: 25.5})
    difference = find_difference(other, default)
    assert difference.by_seed == pytest.approx((1.0, 1.5))
    assert difference.mean == pytest.approx(1.25)
    assert difference.deviation == pytest.approx(0.5 / 2**0.5)
    assert find_difference(made_up_arm("x=1", None, {7: 20.0}), default) is None


@pytest.mark.parametrize(
    ("psnr", "begins"),
    [
        (21.0, "Best change: training.batch=1, +1.00 dB. One seed"),
        (19.5, "No change is better than the default; nearest: training.batch=1, -0.50 dB."),
    ],
)
def test_an_ablation_says_which_change_is_best(psnr, begins):
    default, other = (
        made_up_arm(n, None, {0: p}) for n, p in (("default", 20.0), ("training.batch=1", psnr))
    )
    (finding,) = made_up_study("options", default, other).findings
    assert finding.startswith(begins)


# Tables


def test_an_ablation_has_a_row_for_each_change_with_its_difference():
    default = made_up_arm("default", None, {0: 20.0, 1: 24.0})
    other = made_up_arm("training.batch=1", None, {0: 21.0, 1: 25.5})
    titles, first, second = rows(made_up_study("options", default, other, seeds=(0, 1)))
    assert titles[:3] == ["changed", "difference (dB)", "PSNR, merged (dB)"]
    assert {"SSIM, merged", "Gaussians", "training (s)"} <= set(titles)
    assert first[:3] == ["default", "-", "22.00 ± 2.83"]
    assert second[:3] == ["training.batch=1", "+1.25 ± 0.35", "23.25 ± 3.18"]


def test_several_methods_have_a_column_of_their_own():
    study = made_up_study("options", *arms({0: 20.0}, "abcd-monolithic"), *arms({0: 21.0}))
    titles, *body = rows(study)
    assert titles[:2] == ["method", "changed"]
    assert [row[0] for row in body] == ["abcd-monolithic", "abcd"]
    titles, *body = rows(gaussians_study())
    assert titles[0] == "Gaussians by"
    assert [row[0] for row in body][::5] == ["as it is", "price 64", "MCMC, limit 8,000"]
    titles, *_ = rows(blocks_study())
    assert titles[0] == "blocks"
    assert "peak RAM (GiB)" in titles
    assert "peak GPU memory (GiB)" not in titles  # nowhere measured


@pytest.mark.parametrize("make", STUDIES)
def test_the_written_table_begins_with_what_was_found(make, tmp_path):
    study = make((0, 1))
    write_table(study, tmp_path / "table.md")
    text = (tmp_path / "table.md").read_text()
    assert text.startswith(study.findings[0])
    assert len({line.count("|") for line in text.splitlines() if line.startswith("|")}) == 1
    assert all(note in text for note in notes(study))
    assert "seeds 0, 1" in text


# Charts


def name_of(study) -> str:
    return study.kind.removeprefix("study of ")


@pytest.mark.parametrize("seeds", [(0,), (0, 1, 2)])
@pytest.mark.parametrize("make", STUDIES)
def test_charts_name_what_they_show_and_are_the_same_every_time(make, seeds, tmp_path):
    study, drawn = make(seeds), []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        paths = draw_study(study, tmp_path / name)
        assert [path.name for path in paths] == [f"{name_of(study)}.png", f"{name_of(study)}.svg"]
        drawn.append(paths[1].read_bytes())
    assert drawn[0] == drawn[1]
    texts = texts_of(paths[1])
    wanted = {
        "blocks": ["held-out PSNR (dB)", "blocks", "27", "Gaussians", "peak RAM (GiB)", "best - 0.5 dB"],
        "gaussians": ["held-out PSNR (dB)", "20k", "by price", "by limit", "MCMC", "MiB as .spz"],
        "options": ["training.warmup=0", "change", "PSNR", "Gaussians"],
    }[name_of(study)]
    assert [text for text in wanted if text not in texts] == []


def test_sizes_are_left_out_where_a_run_did_not_ask_for_them(tmp_path):
    known = made_up_arm("default", None, {0: 25.0}, gaussians=4000, spz_bytes=2**20)
    unknown = frontier_arm("training.density.price=1", 9000, 25.1)
    *_, svg = draw_study(made_up_study("gaussians", known, unknown), tmp_path)
    assert [text for text in texts_of(svg) if "MiB" in text] == []


def test_what_chance_does_hardly_shows_in_a_chart_of_options(tmp_path):
    near = made_up_arm("default", None, {0: 25.0}), made_up_arm("training.batch=1", None, {0: 25.01})
    _, svg = draw_study(made_up_study("options", *near), tmp_path)
    ticks = [
        float(t.replace("\N{MINUS SIGN}", "-"))
        for t in texts_of(svg)
        if t.strip("\N{MINUS SIGN}.0123456789") == ""
    ]
    assert min(ticks) <= -0.2
    assert max(tick for tick in ticks if tick < 20) >= 0.2


@pytest.mark.parametrize("study", ["blocks", "gaussians", "options"])
def test_no_run_no_chart(study, tmp_path):
    assert draw_study(made_up_study(study), tmp_path) == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("study", ["blocks", "gaussians"])
def test_a_single_run_has_a_chart_too(study, tmp_path):
    assert len(draw_study(made_up_study(study, *arms({4: 24.0})), tmp_path)) == 2


# Runs


@pytest.fixture
def conditions(scene, tmp_path) -> dict:
    return {"data": scene, "out": tmp_path / "out", "steps": 10}


def carried_out(plan: Plan) -> tuple[int, str]:
    stream = StringIO()
    return carry_out(plan, Console(file=stream, width=100)), stream.getvalue()


def test_a_study_writes_all_it_found(conditions, worker):
    worker.behave({"blocks=1": {"psnr_merged": 25.0}, "blocks=2": {"psnr_merged": 24.75}})
    plan = BlocksStudy(**conditions, blocks=(1, 2)).plan()
    code, printed = carried_out(plan)
    assert code == 0
    assert worker.calls() == ["abcd blocks=1", "abcd blocks=2"]
    results = read_results(plan.out / "results.json")
    assert [(arm.value, arm.psnr) for arm in results.arms] == [(1, 25.0), (2, 24.75)]
    assert "Gap: 0.25 dB" in results.findings[0]
    assert results.findings[0] in printed
    assert "--blocks 1 2" in results.command
    for name in ("table.md", "blocks.png", "blocks.svg"):
        assert (plan.out / name).stat().st_size > 0


def test_more_numbers_and_seeds_may_join_and_what_is_there_is_reused(conditions, worker):
    carried_out(BlocksStudy(**conditions, blocks=(1, 2)).plan())
    worker.calls()
    more = BlocksStudy(**conditions, seeds=(0, 1), blocks=(1, 2, 4))
    _, printed = carried_out(more.plan())
    assert worker.calls() == ["abcd blocks=4", "abcd blocks=1", "abcd blocks=2", "abcd blocks=4"]
    assert printed.count("reused") == 2


def test_a_failed_run_is_named_and_the_others_are_reported(conditions, worker):
    worker.behave({"training.batch=1": "raises"})
    plan = OptionsStudy(**conditions, vary=("training.batch=1", "training.warmup=0")).plan()
    code, _ = carried_out(plan)
    assert code == 1
    results = read_results(plan.out / "results.json")
    assert [arm.variant for arm in results.arms] == ["default", "training.warmup=0"]
    assert [failure.variant for failure in results.failures] == ["training.batch=1"]
    text = (plan.out / "table.md").read_text()
    assert "abcd, training.batch=1, seed 0 failed" in text
    assert "ValueError: the scene is empty" in text


def test_where_the_default_failed_there_is_no_difference(conditions, worker):
    worker.behave(abcd="raises")
    plan = OptionsStudy(**conditions, vary=("training.batch=1",)).plan()
    assert carried_out(plan)[0] == 1
    assert "the default's runs failed" in (plan.out / "table.md").read_text()
    assert not (plan.out / "options.png").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [({"steps": 11}, "holds runs with steps 10, not 11"), ({"downscale": 2}, "downscale")],
)
def test_another_protocol_is_refused(conditions, worker, change, message):
    carried_out(BlocksStudy(**conditions, blocks=(1, 2)).plan())
    worker.calls()
    with pytest.raises(UserError, match=message):
        carried_out(BlocksStudy(**{**conditions, **change}, blocks=(1, 2)).plan())
    assert worker.calls() == []


@pytest.mark.usefixtures("worker")
def test_another_kind_of_study_is_refused(conditions):
    carried_out(BlocksStudy(**conditions, blocks=(1, 2)).plan())
    other = OptionsStudy(**conditions, vary=("blocks=2",)).plan()
    with pytest.raises(UserError, match="holds no study of options"):
        carry_out(other, Console(file=StringIO()), overwrite=True)


@pytest.mark.parametrize("make", STUDIES)
def test_results_come_back_as_they_were_written(make, tmp_path):
    study = make((0, 1))
    write_json(tmp_path / "results.json", encode(study))
    assert read_results(tmp_path / "results.json") == study


def test_a_study_that_really_trains(scene, tmp_path, monkeypatch):
    """Two numbers of blocks, under a limit below the scene's 300 points."""
    jobs_in_this_process(monkeypatch)
    given = {"data": scene, "out": tmp_path / "out", "steps": 12, "evals": 2, "max_gaussians": 150}
    code, printed = carried_out(BlocksStudy(**given, blocks=(1, 3)).plan())
    assert code == 0, printed
    results = read_results(tmp_path / "out" / "results.json")
    for arm, blocks in zip(results.arms, (1, 3), strict=True):
        (run,) = arm.runs
        assert (run.blocks, run.steps) == (blocks, 12)
        assert 100 < run.gaussians <= 150  # some go at the end
        assert [point.gaussians for point in run.curve][-1] == run.gaussians
        assert arm.psnr > 8
