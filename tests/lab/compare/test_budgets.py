"""`abcd compare --budgets`: what runs within which memory, and its chart."""

from io import StringIO

import pytest
from rich.console import Console

from abcd_ns.engine.train.memory import DeviceNeeds
from abcd_ns.lab.compare.charts import draw_budgets
from abcd_ns.lab.compare.command import Options, make_plan, shares_of, within_budgets
from abcd_ns.lab.job import Job
from abcd_ns.lab.runs.configs import trainer_config
from abcd_ns.lab.runs.runner import run_jobs

JOINT_BYTES = 8_000_000


@pytest.fixture
def options(tmp_path) -> Options:
    methods = ("abcd", "abcd-partition", "splatfacto-scaled")
    given = {"methods": methods, "steps": 10, "seeds": (0, 1), "budgets": ("1/4", "1/2")}
    return Options(data=str(tmp_path), out=str(tmp_path / "out"), **given)


def test_every_method_of_abcds_and_joint_training_get_each_share(options, worker, tmp_path, drawn):
    """Joint training took so many bytes; the chart is of what the others took."""
    took = {"gaussian_bytes": JOINT_BYTES}
    worker.behave({"abcd-monolithic": took, "splatfacto-scaled": took})
    plan = make_plan(options)
    assert "--budgets 1/4 1/2" in plan.command
    assert "--blocks" not in plan.command.split()
    *_, ceilings = run_jobs(plan, Console(file=StringIO()))
    assert worker.calls() == ["abcd-monolithic", "splatfacto-scaled"] * 2
    plan = within_budgets(plan, ceilings, options.methods, shares_of(options.budgets))
    within = {f"gaussian_bytes={JOINT_BYTES // n}": {"gaussian_bytes": JOINT_BYTES // n - 9} for n in (2, 4)}
    worker.behave(within)
    *_, results = run_jobs(plan, Console(file=StringIO()))
    methods = ("abcd-monolithic", "abcd", "abcd-partition")
    assert [(arm.method, arm.variant) for arm in results.arms] == [
        ("abcd-monolithic", "default"),
        ("splatfacto-scaled", "default"),
        *((method, f"gaussian_bytes={JOINT_BYTES // n}") for n in (2, 4) for method in methods),
    ]
    assert all(len(arm.runs) == 2 for arm in results.arms)
    assert len(worker.calls()) == 12  # ceilings are not run again

    (path,) = draw_budgets(results, tmp_path)
    texts = {"held-out PSNR (dB)", "held-out SSIM", "peak memory of Gaussians (MiB)"}
    assert texts | {"abcd within a budget", "splatfacto-scaled without a limit"} <= set(drawn[path.name])


def test_joint_training_has_as_many_gaussians_as_fit_and_blocks_choose_for_themselves(options, tmp_path):
    settings, share = make_plan(options).settings, JOINT_BYTES // 4
    jobs = (Job(m, 0, settings, (f"gaussian_bytes={share}",)) for m in ("abcd-monolithic", "abcd"))
    joint, blocks = (trainer_config(job, tmp_path).pipeline for job in jobs)
    assert joint.blocks == 1
    assert joint.training.density.max_gaussians == share // DeviceNeeds(0, 1).gaussian_bytes
    assert (blocks.blocks, blocks.gaussian_bytes, blocks.training.density.max_gaussians) == (0, share, 0)
    assert blocks.workers == 1  # one device
