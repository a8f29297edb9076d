"""What a run chose by the device's memory, it keeps: through training, on disk, and when it goes on."""

import torch

from abcd_ns import methods
from abcd_ns.engine.events import Event, StepTaken
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.train.recipe import Limits
from abcd_ns.engine.train.step.final_pruning import FinalPruning
from abcd_ns.nerfstudio.datamanager import AbcdDataManager
from abcd_ns.nerfstudio.trainer import AbcdTrainer
from abcd_ns.run.fit import Fit
from abcd_ns.units import GIB
from tests.nerfstudio.crash_training import assert_same
from tests.nerfstudio.test_training import configure, run

STEPS = 16
LIMITS = {"block_limit": 5000, "sole_limit": 5000, "batch_limit": 1, "crop_pixels": 600}
FIT = Fit(blocks=3, budget=GIB, gaussians=300, limits=Limits(**LIMITS))


def test_a_run_keeps_to_what_it_chose_and_so_does_one_that_goes_on(data, tmp_path, monkeypatch, capsys):
    crops, photo = [], AbcdDataManager.photo

    def noted(manager, row, crop):
        crops.append(crop)
        return photo(manager, row, crop)

    monkeypatch.setattr(AbcdDataManager, "photo", noted)
    monkeypatch.setattr(FinalPruning, "run", lambda _: None)  # it reads whole photos, and reduces them
    with monkeypatch.context() as patched:
        patched.setattr("abcd_ns.run.fit.find_fit", lambda *_: FIT)
        straight = run(configure(data, tmp_path / "straight", blocks=0, steps=STEPS))
        stopped = run(configure(data, tmp_path / "stopped", blocks=0, steps=STEPS), stop_after=9)
    assert "steps draw parts of 0.0006 megapixels" in capsys.readouterr().out
    with ParameterStore.open(stopped.base_dir / "abcd/store", read_only=True) as store:
        assert {name: store.header[name] for name in LIMITS} == LIMITS
    resumed = run(configure(data, tmp_path / "again", blocks=0, steps=STEPS, load_dir=stopped.base_dir))
    assert resumed.pipeline.coordinator.config.limits.crop_pixels == 600
    assert resumed.pipeline.coordinator.config.limits.batch_limit == 1
    assert len(crops) > STEPS
    assert max(crop.pixels for crop in crops) <= 600
    assert_same(resumed.base_dir, straight.base_dir)


def test_a_run_that_resumes_with_the_budget_it_has_keeps_its_limits(data, tmp_path, monkeypatch):
    """By the Gaussians that have come since, the same budget would give others, or be refused."""

    def begun(name: str, budget: float, stop_after: int, **options) -> AbcdTrainer:
        config = configure(data, tmp_path / name, blocks=0, steps=STEPS, **options)
        config.pipeline.device_budget_gb = budget
        return run(config, stop_after=stop_after)

    with monkeypatch.context() as patched:
        patched.setattr("abcd_ns.run.fit.find_fit", lambda *_: FIT)
        folder = begun("stopped", 0.5, 9).base_dir
    same, other = (begun(f"with {gib}", gib, 11, load_dir=folder) for gib in (0.5, 2.0))
    limits = [trainer.pipeline.coordinator.config.limits.sole_limit for trainer in (same, other)]
    assert limits[0] == LIMITS["sole_limit"] != limits[1]
    later = begun("without", 0.0, 13, load_dir=other.base_dir)
    assert later.pipeline.coordinator.config.limits.sole_limit == limits[1]
    more = begun("with more", 4.0, 15, load_dir=later.base_dir)
    assert more.pipeline.coordinator.config.limits.sole_limit > limits[1]


def test_where_memory_is_full_the_blocks_are_named_that_there_are(data, tmp_path, said_at_exit):
    def full(event: Event) -> None:
        if isinstance(event, StepTaken):
            raise torch.cuda.OutOfMemoryError

    config = configure(data, tmp_path, methods.abcd_partition, blocks=0, steps=STEPS)
    config.pipeline.gaussian_bytes = GIB
    assert "The device's memory does not hold 2 blocks." in said_at_exit(run, config, listener=full)
