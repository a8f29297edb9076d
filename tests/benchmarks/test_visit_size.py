"""The benchmark of a visit by its size, on a visit that is next to nothing."""

from benchmarks.visit_size import STAGES, Args, main, measure

SMALL = Args(gaussians=40, blocks=2, width=48, views=2, steps=2)


def test_every_stage_of_one_visit_is_measured(tmp_path):
    seconds, known = measure(SMALL, tmp_path)
    assert set(seconds) == set(STAGES)
    assert all(seconds[stage] > 0 for stage in STAGES)
    assert known["views"] == 2
    assert known["layer_bytes"] > 0
    assert known["drawn"] == 8


def test_the_table_has_a_line_for_each(capsys):
    main(SMALL)
    lines = capsys.readouterr().out.splitlines()
    assert all(any(line.startswith(f"| {stage} |") for line in lines) for stage in STAGES)
    assert "all but steps" in lines[-1]
