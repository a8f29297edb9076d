"""Fog: Gaussians between a camera and all that its photo is known to show.

They imitate what differs from photo to photo, as vignettes do, and veil other views.
"""

from dataclasses import replace

import torch

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.types import Gaussians, View

NEARER = 0.85
"""Of the view's nearest point: Gaussians with a smaller camera z are fog."""


def fog_in_white(gaussians: Gaussians, view: View) -> Gaussians:
    """The same with fog white and all else black: the mean of their picture, drawn with harmonics of degree 0
    before black, is the share of the screen that fog takes."""
    matrix = view.viewmat.to(gaussians.means)
    z = gaussians.means @ matrix[2, :3] + matrix[2, 3]
    white = torch.where(z < NEARER * view.nearest, 0.5, -0.5) / SH_C0
    dark = torch.zeros_like(gaussians.features_rest)
    return replace(gaussians, features_dc=white[:, None].expand(-1, 3).contiguous(), features_rest=dark)
