"""How scenarios train."""

from abcd_ns.lab.stability.lab import Lab, make_stage


def test_a_labs_seed_is_that_of_its_trainings_unless_they_name_one(tmp_path):
    stage = make_stage()
    lab = Lab(tmp_path, seed=3)
    assert lab.coordinator(stage, budget=100).config.seed == 3
    assert lab.coordinator(stage, budget=100, seed=5).config.seed == 5
