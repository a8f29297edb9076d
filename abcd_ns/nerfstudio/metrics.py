"""How close a picture is to its photo, by the measures splatfacto reports."""

import os
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from pytorch_msssim import ssim
from torch import Tensor
from torch.nn.functional import interpolate

from abcd_ns.engine.render.loss import SSIM_WINDOW, psnr
from abcd_ns.errors import UserError

ALEXNET = "alexnet-owt-7be5be79.pth"
"""The file of AlexNet's weights, as torchvision names it in torch's hub folder."""
LEAST_LPIPS = 31  # pixels along a side, of which AlexNet's layers leave something
FETCH = "ABCD_FETCH_LPIPS"
"""The environment variable that allows torchvision to download them; ns-eval has no options for it."""


def image_metrics(
    rendered: Float[Tensor, "h w 3"],
    photo: Float[Tensor, "h w 3"],
    corrected: bool = False,
    mask: Bool[Tensor, "h w 1"] | None = None,
) -> dict[str, float]:
    """`psnr` (dB), `ssim` and, where LPIPS' weights are on this machine, `lpips`; `cc_psnr` if `corrected`.

    Sides shorter than SSIM's window, or LEAST_LPIPS, are stretched to it. With a mask, PSNRs are of the
    pixels where it is true, and the others of pictures that are black elsewhere.
    """
    a, b = (image.permute(2, 0, 1)[None] for image in (rendered, photo))
    if mask is not None:
        a, b = (image * mask[..., 0].to(image.device) for image in (a, b))
        rendered, photo = counted(rendered, mask), counted(photo, mask)
    similar = ssim(*_of_size(SSIM_WINDOW, a, b), data_range=1.0, size_average=True)
    found = {"psnr": float(psnr(rendered, photo)), "ssim": float(similar)}
    if corrected:
        found["cc_psnr"] = corrected_psnr(rendered, photo)
    if lpips_missing() is None:
        pair = _of_size(LEAST_LPIPS, a.clamp(0, 1), b.clamp(0, 1))
        found["lpips"] = float(_lpips(str(rendered.device))(*pair))
    return found


def _of_size(least: int, *images: Float[Tensor, "1 3 h w"]) -> list[Float[Tensor, "1 3 _h _w"]]:
    """Images with sides of `least` pixels or more; shorter ones are stretched by repeating pixels."""
    return [interpolate(image, [max(side, least) for side in image.shape[2:]]) for image in images]


def counted(picture: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w 1"] | None) -> Float[Tensor, "_h _w 3"]:
    """The pixels at which a mask is true, [1, n, 3]; all without one."""
    return picture if mask is None else picture[mask[..., 0].to(picture.device)][None]


def corrected_psnr(rendered: Float[Tensor, "h w 3"], photo: Float[Tensor, "h w 3"]) -> float:
    """Splatfacto's `cc_psnr`, dB: PSNR after the picture's colours were warped to the photo's by least
    squares (quadratic, as in RawNeRF's code), which leaves the photo's light out."""
    from nerfstudio.model_components.lib_bilagrid import color_correct

    rendered, photo = rendered.cpu(), photo.cpu()  # where least squares may be short of rank: black pictures
    return float(psnr(color_correct(rendered, photo), photo))


def lpips_missing() -> str | None:
    """Why LPIPS cannot be computed, or None. Nothing is downloaded unless FETCH is set."""
    weights = Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET
    if weights.is_file() or os.environ.get(FETCH):
        return None
    return (
        f"LPIPS needs AlexNet's weights, 233 MiB: set {FETCH}=1 to have torchvision fetch them, or put its "
        f"{ALEXNET} into {weights.parent}"
    )


@cache
def _lpips(device: str) -> torch.nn.Module:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).to(device)
    except OSError as error:  # of the network or the disk
        raise UserError(f"AlexNet's weights could not be fetched ({error}); unset {FETCH}.") from error
