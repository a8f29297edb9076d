"""`abcd compare --budgets`: what runs within which memory, and its chart."""

from io import StringIO

import pytest
from rich.console import Console

from abcd_ns.engine.train.memory import DeviceNeeds
from abcd_ns.errors import UserError
from abcd_ns.lab.compare.budgets import draw_budgets, shares_of, within_budgets
from abcd_ns.lab.compare.command import Options, make_plan
from abcd_ns.lab.runs.configs import trainer_config
from abcd_ns.lab.runs.runner import run_jobs

JOINT_BYTES = 8_000_000


@pytest.fixture
def options(tmp_path) -> Options:
    scene = tmp_path / "scene"
    scene.mkdir()
    methods = ("abcd", "abcd-partition", "splatfacto-scaled")
    given = {"methods": methods, "steps": 10, "seeds": (0, 1), "budgets": ("1/4", "1/2")}
    return Options(data=str(scene), out=str(tmp_path / "out"), **given)


@pytest.fixture
def results(options, worker):
    """The whole plan, and what came of it, joint training having taken so many bytes."""
    took = {"gaussian_bytes": JOINT_BYTES}
    worker.behave(abcd_monolithic=took, splatfacto_scaled=took)
    plan = make_plan(options)
    *_, ceilings = run_jobs(plan, Console(file=StringIO()))
    assert worker.calls() == ["abcd-monolithic", "splatfacto-scaled"] * 2
    plan = within_budgets(plan, ceilings, options.methods, shares_of(options.budgets))
    within = {f"gaussian_bytes={JOINT_BYTES // n}": {"gaussian_bytes": JOINT_BYTES // n - 9} for n in (2, 4)}
    worker.behave(within)
    *_, results = run_jobs(plan, Console(file=StringIO()))
    return plan, results


def test_every_method_of_abcds_and_joint_training_get_each_share(results, worker):
    found = [(arm.method, arm.variant) for arm in results[1].arms]
    assert found == [
        ("abcd-monolithic", "default"),
        ("splatfacto-scaled", "default"),
        *(
            (method, f"gaussian_bytes={JOINT_BYTES // n}")
            for n in (2, 4)
            for method in ("abcd-monolithic", "abcd", "abcd-partition")
        ),
    ]
    assert all(len(arm.runs) == 2 for arm in results[1].arms)
    assert len(worker.calls()) == 12  # ceilings are not run again


def test_joint_training_has_as_many_gaussians_as_fit_and_blocks_choose_for_themselves(results, tmp_path):
    plan, _ = results
    configs = {job.name: trainer_config(job, tmp_path).pipeline for job in plan.jobs if job.changes}
    share = JOINT_BYTES // 4
    joint = configs[f"abcd-monolithic, gaussian_bytes={share}, seed 0"]
    assert joint.blocks == 1
    assert joint.training.density.max_gaussians == share // DeviceNeeds(0, 1).gaussian_bytes
    blocks = configs[f"abcd, gaussian_bytes={share}, seed 0"]
    assert (blocks.blocks, blocks.gaussian_bytes, blocks.training.density.max_gaussians) == (0, share, 0)
    assert blocks.workers == 1  # one device


def test_the_chart_has_quality_over_measured_memory(results, tmp_path, drawn):
    (path,) = draw_budgets(results[1], tmp_path)
    texts = drawn[path.name]
    assert {"held-out PSNR (dB)", "held-out SSIM", "peak memory of Gaussians (MiB)"} <= set(texts)
    assert {"abcd within a budget", "splatfacto-scaled without a limit"} <= set(texts)


@pytest.mark.parametrize("share", ["0", "-1/2", "2", "half", "1/0"])
def test_a_budget_that_is_no_share_is_refused(options, share):
    with pytest.raises(UserError, match=r"--budgets .*give shares above 0 and up to 1"):
        make_plan(Options(**{**vars(options), "budgets": (share,)}))


@pytest.mark.parametrize("other", [{"blocks": (4,)}, {"vary": ("training.warmup=0",)}, {"max_gaussians": 9}])
def test_what_contradicts_budgets_is_refused_by_name(options, other):
    with pytest.raises(UserError, match=f"--{min(other).replace('_', '-')} does not go with --budgets"):
        make_plan(Options(**{**vars(options), **other}))


def test_the_command_that_is_written_makes_the_same(options):
    plan = make_plan(options)
    assert "--budgets 1/4 1/2" in plan.command
    assert not {"--blocks", "--max-gaussians"} & set(plan.command.split())
