"""The loss' Triton kernels, run by Triton's interpreter where there is no GPU."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("triton")

COMPARE = """
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


def test_they_are_the_kernels_of_the_cpu():
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run(
        [sys.executable, "-c", COMPARE], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
