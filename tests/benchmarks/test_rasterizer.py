"""The rasterizer's benchmark times every side at every size."""

from benchmarks import rasterizer


def test_every_side_is_timed_at_every_size(capsys):
    rasterizer.main(rasterizer.Args(gaussians=50, widths=(16, 24), rounds=1))
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert [cell.strip() for cell in rows[0][1:]] == ["16x10", "24x16"]
    assert [row[0].strip() for row in rows[2:4]] == ["native, forward", "native, forward + backward"]
    assert all(float(cell) > 0 for row in rows[2:] for cell in row[1:])
