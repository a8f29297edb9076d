"""Options, plans and TOML files: what is refused, and what wins."""

from pathlib import Path

import pytest

from abcd_ns.errors import UserError
from abcd_ns.lab.compare.command import Options, make_plan, read_options
from abcd_ns.lab.job import METHODS
from abcd_ns.lab.results.records import own_configs
from abcd_ns.lab.runs.configs import check_options, trainer_config

TILES = {"data": None, "steps": None, "tiles": (2, 4)}


def options(scene: Path, **given) -> Options:
    return Options(**{"data": str(scene), "out": "out", "steps": 10, **given})


@pytest.mark.parametrize("method", [method for method in METHODS if method.startswith("abcd")])
def test_every_method_trains_under_its_own_name_by_its_own_options(tmp_path, method):
    (job,) = make_plan(options(tmp_path, methods=(method,), steps=90, blocks=(4,))).jobs
    config = trainer_config(job, tmp_path)
    training = config.pipeline.training
    assert config.method_name == method
    assert config.pipeline.blocks == (1 if method == "abcd-monolithic" else 4)
    assert (training.recipe.overlap > 0) == (method == "abcd-partition")
    assert training.recipe.exact == (method == "abcd-exact")
    assert training.recipe.visit_steps == (23 if method == "abcd-paper" else 0)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"data": None}, "--data"),
        ({"data": "nowhere"}, "--data nowhere does not exist"),
        ({"out": None}, "--out"),
        ({"steps": None}, "either --seconds or --steps"),
        ({"seconds": 5.0}, "either --seconds or --steps"),
        ({"steps": None, "seconds": float("nan")}, "--seconds is nan"),
        ({"blocks": (2, 2)}, "--blocks 2 2: give different numbers"),
        ({"blocks": (1, 65_537)}, "--blocks is 65537; it must be at most 65536"),
        ({"vary": ("training.batch=1", "training.btach=2")}, "no option 'training.btach'"),
        ({"vary": ("blocks=2 workers=1", "workers=1 blocks=2")}, "'blocks=2 workers=1' is given twice"),
        ({"vary": ("blocks=2",), "blocks": (1, 8)}, "'blocks=2' is given twice"),
        ({"methods": ()}, "at least one"),
        ({"methods": ("abcd", "abcd")}, "each once"),
        ({"methods": ("abcd-paper",), "steps": None, "seconds": 9.0}, "abcd-paper .* use --steps"),
        ({"seeds": (1, 1)}, "different numbers"),
        ({"visits": 5}, "--visits goes with --tiles only"),
        ({"tile_gaussians": 9}, "--tile-gaussians goes with --tiles only"),
        ({"vary": ("device-budget-gb=1",)}, "no effect where the number of blocks is given"),
        ({"budgets": ("1/4",), "blocks": (4,)}, "--blocks does not go with --budgets"),
        ({"budgets": ("1/4",), "vary": ("training.warmup=0",)}, "--vary does not go with --budgets"),
        *(({"budgets": (n,)}, "give shares above 0 and up to 1") for n in ("0", "-1/2", "2", "half", "1/0")),
        (TILES | {"tiles": (2, 6)}, "powers of 2"),
        (TILES | {"tiles": (4, 4)}, "different"),
        (TILES | {"tiles": (0,)}, "from 1 on"),
        (TILES | {"tiles": ()}, "different"),
        (TILES | {"tile_gaussians": 0}, "--tile-gaussians is 0"),
        (TILES | {"visits": 0}, "--visits is 0"),
        (TILES | {"data": "scene"}, "--data does not go with --tiles"),
        (TILES | {"steps": 9, "vary": ("training.batch=1",)}, "--steps does not go with --tiles"),
        (TILES | {"methods": ("abcd", "abcd-exact")}, "not abcd-exact"),
        (TILES | {"tiles": (2**18,), "tile_gaussians": 10**6}, "GiB free"),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(tmp_path, given, message):
    with pytest.raises(UserError, match=message) as caught:
        make_plan(options(tmp_path, **given))
    assert "\n" not in str(caught.value)


def test_the_command_line_goes_before_the_file():
    file = Options(steps=100, blocks=(4,), methods=("abcd",), downscale=2)
    merged = Options(seconds=5.0, blocks=(2,)).over(file)
    assert (merged.seconds, merged.steps) == (5.0, None)
    assert (merged.blocks, merged.downscale, merged.methods) == ((2,), 2, ("abcd",))
    assert Options().over(file) == file


def test_every_method_with_every_seed_block_count_and_change_has_a_folder_of_its_own(tmp_path):
    methods = ("splatfacto", "abcd", "abcd-monolithic")
    given = {"blocks": (4, 1), "seeds": (3, 1), "vary": ("training.batch=1",)}
    plan = make_plan(options(tmp_path, methods=methods, **given))
    batch = "training.batch=1"
    once = [("abcd-monolithic", "default"), ("abcd-monolithic", batch)]
    once += [("abcd", f"blocks={n}{more}") for n in (1, 4) for more in ("", f" {batch}")]
    once += [("splatfacto", "default")]
    assert [(job.method, job.variant) for job in plan.jobs] == 2 * once
    assert [job.seed for job in plan.jobs] == [3] * 7 + [1] * 7
    assert [trainer_config(job, tmp_path).pipeline.blocks for job in plan.jobs[:6]] == [1, 1, 1, 1, 4, 4]
    assert plan.jobs[2].folder(Path("out")) == Path("out/runs/abcd/blocks=1-seed-3")
    assert len({job.folder(plan.out) for job in plan.jobs}) == 14
    assert "--blocks 4 1" in plan.command


def test_changes_are_arms_beside_the_method_as_it_is_and_one_block_is_one_block(tmp_path):
    vary = "training.density.min_contribution=0.5", "blocks=9", "partition=grid blocks=27"
    methods = ("abcd-monolithic", "abcd")
    plan = make_plan(options(tmp_path, methods=methods, blocks=(4,), vary=vary))
    configs = [trainer_config(job, tmp_path).pipeline for job in plan.jobs]
    blocks = [("default", 4), (vary[0], 4), (vary[1], 9), (vary[2], 27)]
    expected = [("abcd-monolithic", name, 1) for name in ("default", vary[0], "partition=grid")]
    expected += [("abcd", name, count) for name, count in blocks]
    found = zip(plan.jobs, configs, strict=True)
    assert [(job.method, job.variant, config.blocks) for job, config in found] == expected
    assert configs[1].training.density.min_contribution == 0.5
    assert f"--vary {vary[0]} {vary[1]} '{vary[2]}'" in plan.command


def test_a_change_of_many_options_has_a_folder_of_its_own_that_disks_take(tmp_path):
    names = "min_contribution", "split_pixels", "refine_start", "refine_stop", "cull_alpha_thresh"
    long = " ".join(f"training.density.{name}=0.25" for name in names) + " training.warmup=0.2"
    plan = make_plan(options(tmp_path, vary=(f"{long} training.batch=1", f"{long} training.batch=2")))
    folders = {job.folder(tmp_path) for job in plan.jobs}
    assert len(folders) == 3
    assert all(len(folder.name) < 255 for folder in folders)


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ("blocks=0", "blocks must be 1 to 65536, not 0"),
        ("blocks=65537", "blocks must be 1 to 65536, not 65537"),
        ("model.num_downscales=1", "has no effect here"),
    ],
)
def test_changes_that_cannot_be_trained_are_refused(tmp_path, vary, message):
    with pytest.raises(UserError, match=message):
        check_options(make_plan(options(tmp_path, vary=(vary,))).jobs[1])


@pytest.mark.parametrize("path", own_configs(trains=False), ids=lambda path: path.stem)
def test_the_examples_make_plans(path, tmp_path):
    plan = make_plan(Options(data=str(tmp_path), out="out").over(read_options(path)))
    assert {job.method for job in plan.jobs} <= set(METHODS)


def test_a_bad_file_is_refused_in_one_line(tmp_path):
    path = tmp_path / "compare.toml"
    path.write_text("methods = ['nerfacto']")
    with pytest.raises(UserError, match="nerfacto") as caught:
        read_options(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
