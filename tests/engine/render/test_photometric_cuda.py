"""The Triton kernels, run by Triton's interpreter where there is no GPU, against their torch twins."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton")

LOSS = """
import torch
from abcd_ns.engine.kernels.photometric import photometric_sums
from abcd_ns.engine.render.cuda.photometric import photometric

generator = torch.Generator().manual_seed(0)
for height, width in ((11, 11), (11, 40), (29, 12), (33, 61)):
    rendered, photo = torch.rand(2, height, width, 3, generator=generator)
    photo[:5] = rendered[:5]
    loss, gradient = photometric(rendered, photo, 0.3, 0.7)
    weights = torch.tensor([0.3, 0.7])
    planes = (image.permute(2, 0, 1).double().contiguous() for image in (rendered, photo))
    sums, expected = photometric_sums(*planes, weights.double())
    torch.testing.assert_close(loss.double(), sums @ weights.double(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(gradient.double(), expected.permute(1, 2, 0), rtol=1e-4, atol=1e-5)
"""
STATISTICS = """
import torch
from abcd_ns.engine.render.cuda.statistics import statistics
from tests.reference import triton_stand_ins as twins

generator = torch.Generator().manual_seed(0)
for views, n in ((1, 1), (1, 300), (4, 257)):
    gradient = torch.randn(views, n, 2, generator=generator)
    radii = torch.randint(0, 3, (views, n), generator=generator, dtype=torch.int32)
    weights = torch.rand(views, n, generator=generator)
    sums = list(torch.rand(4, n, generator=generator))
    gradient[0, ::7], gradient[-1, ::11], weights[0, ::5] = torch.nan, torch.inf, torch.nan
    given = gradient, radii, weights, sums, (320.0, 240.0), views / 3
    torch.testing.assert_close(statistics(*given), twins.statistics(*given), rtol=1e-6, atol=1e-5)
"""


@pytest.mark.parametrize("compare", [LOSS, STATISTICS])
def test_they_are_their_twins(compare):
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run(
        [sys.executable, "-c", compare], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
