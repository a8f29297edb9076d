"""What gsplat 1.4.0's 2DGS kernels compute, in torch; see gsplat_stand_ins."""

from collections.abc import Sequence

import torch
from gsplat.cuda._torch_impl_2dgs import _fully_fused_projection_2dgs
from torch import Tensor

from tests.reference.differentiable_kernel import Differentiable, stands_in


def place_surfels(
    tensors: Sequence[Tensor], width: int, height: int, near_plane: float, far_plane: float
) -> list[Tensor]:
    """(radii, means2d, depths, ray_transforms, normals) of one camera: gsplat's own reference, but for radii.

    That has no least radius, as the kernel does, and none where a disc crosses the camera's plane.

    Args:
        tensors: means, quats, scales, viewmat, K.
    """
    means, quats, scales, viewmat, K = tensors
    found = _fully_fused_projection_2dgs(means, quats, scales, viewmat[None], K[None], width, height)
    _, means2d, depths, rays, normals = (value[0] for value in found)
    rays = rays.transpose(1, 2)  # the kernel has rows for x, y and w
    with torch.no_grad():
        sign = rays.new_tensor([1.0, 1.0, -1.0])
        f = sign / (rays[:, 2].square() * sign).sum(-1)[:, None]
        extent = means2d.square() - (rays[:, :2].square() * f[:, None]).sum(-1)
        radii = (3 * extent.amax(-1).clamp_min(1e-4).sqrt()).ceil()
        size = means2d.new_tensor([width, height])
        inside = ((means2d + radii[:, None] > 0) & (means2d - radii[:, None] < size)).all(-1)
        drawn = inside & (depths >= near_plane) & (depths <= far_plane)
    return [torch.where(drawn, radii, 0.0).int(), means2d, depths, rays, normals]


@stands_in(eps2d=0.3, radius_clip=0.0, packed=False, sparse_grad=False)
def fully_fused_projection_2dgs(
    means, quats, scales, viewmats, Ks, width, height, near_plane, far_plane
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """radii [C, N], means2d [C, N, 2], depths [C, N], ray_transforms [C, N, 3, 3], normals [C, N, 3]. As in
    CUDA, cameras get no gradient."""
    size = width, height, near_plane, far_plane

    def _place(*tensors: Tensor) -> list[Tensor]:
        *surfels, viewmats, Ks = tensors
        found = []
        for camera in zip(viewmats, Ks, strict=True):
            with torch.no_grad():
                radii = place_surfels((*surfels, *camera), *size)[0]
            drawn = (radii > 0).nonzero()[:, 0]
            values = place_surfels((*(x[drawn] for x in surfels), *camera), *size)[1:]
            empty = [x.new_full((len(radii), *x.shape[1:]), torch.nan) for x in values]
            found.append([radii, *(e.index_copy(0, drawn, v) for e, v in zip(empty, values, strict=True))])
        return [torch.stack(values) for values in zip(*found, strict=True)]

    return Differentiable.apply(_place, means, quats, scales, viewmats.detach(), Ks.detach())


def surfel_sigma(offset: Tensor, rays: Tensor, pixels: Tensor) -> Tensor:
    """[pairs, pixels] from the boxes' middles less the pixels, ray transforms, and the pixels."""
    u, v, w = (row[:, None] for row in rays.unbind(1))
    h_u, h_v = pixels[..., :1] * w - u, pixels[..., 1:] * w - v
    s, t, z = torch.linalg.cross(h_u, h_v).unbind(-1)
    on_disc = (s.square() + t.square()) / z.square()
    return 0.5 * torch.minimum(on_disc, 2 * offset.square().sum(-1))
