"""Alpha compositing of projected Gaussians as one differentiable function of bounded memory."""

from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.rasterizer.binning import TileLists
from abcd_ns.engine.rasterizer.chunk_kernels import ChunkKernels
from abcd_ns.engine.rasterizer.torch_kernels import GRADIENTS, MOMENTS, STATE_PLANES, gather_params

COMPACT = 0.75
"""Tiles whose pixels are all finished are dropped once fewer than this share is left."""


@dataclass
class Job:
    """All that a drawing needs besides tensors that take gradients."""

    lists: TileLists
    kernels: ChunkKernels
    windows: Float[Tensor, "2 p a"] | None
    """near and far, in the columns of `lists.tiles`."""
    always: Float[Tensor, "m"]
    """By rank: 1 where no window applies."""
    absgrad_target: Tensor | None
    """Gets an attribute `absgrad` in the backward pass: means2d [1, n, 2] of the first n splats."""


@dataclass
class _Trace:
    """What the forward pass leaves for the backward pass."""

    columns: list[Tensor | None] = field(default_factory=list)
    """Per level, which of its columns were drawn; None means all."""
    states: list[Tensor] = field(default_factory=list)
    """Per level, the state before it."""


def _parameter_table(job: Job, means2d, conics, colors, opacities, depths) -> Float[Tensor, "c columns"]:
    """One column per rank, in the order of torch_kernels; the last, for empty slots, has opacity 0."""
    rows = job.lists.rows
    columns = (means2d, conics, opacities[:, None], depths[:, None])
    means2d, conics, opacities, depths = (x.index_select(0, rows).T for x in columns)
    parts = (means2d, conics, opacities, colors.T, depths, job.always[None])
    return F.pad(torch.cat(parts), (0, 1))


def _initial_state(lists: TileLists, dtype: torch.dtype) -> Float[Tensor, "5 p a"]:
    grid = lists.grid
    inside = torch.ones((1, grid.crop.height, grid.crop.width), device=lists.tiles.device, dtype=dtype)
    state = inside.new_zeros((STATE_PLANES, grid.pixels_per_tile, lists.tiles.numel()))
    state[0] = grid.to_tiles(inside, fill=-1.0)[0].index_select(1, lists.tiles)
    return state


def _live_columns(state: Float[Tensor, "5 p a"]) -> Int[Tensor, "b"] | None:
    """The columns with an unfinished pixel, if dropping the others is worth it."""
    live = (state[0] > 0).any(dim=0).nonzero()[:, 0]
    return live if live.numel() < COMPACT * state.shape[2] else None


def _level_ranks(lists: TileLists, index: int, columns: Tensor | None) -> Int[Tensor, "k a"]:
    level = lists.levels[index]
    ranks = lists.ranks[level.start : level.start + lists.chunk * level.width].view(lists.chunk, level.width)
    return ranks if columns is None else ranks.index_select(1, columns)


def _take(planes: Tensor | None, width: int, columns: Tensor | None) -> Tensor | None:
    """The columns of a level from planes [..., a] that hold all tiles' columns."""
    if planes is None:
        return None
    return planes[..., :width].contiguous() if columns is None else planes.index_select(-1, columns)


def _composite(
    job: Job, table: Tensor, origins: Float[Tensor, "2 a"], keep_states: bool
) -> tuple[Float[Tensor, "5 p a"], _Trace]:
    """Draw all levels, front to back. Returns the final state of every tile and the trace."""
    lists, trace = job.lists, _Trace()
    state, columns = _initial_state(lists, table.dtype), None
    final = state.clone()
    for index, level in enumerate(lists.levels):
        if columns is not None and level.width < lists.levels[index - 1].width:
            keep = int((columns < level.width).sum())
            final.index_copy_(2, columns[keep:], state[..., keep:])
            columns, state = columns[:keep], state[..., :keep].contiguous()
        elif level.width < state.shape[2]:
            final[..., level.width : state.shape[2]] = state[..., level.width :]
            state = state[..., : level.width].contiguous()
        live = _live_columns(state)
        if live is not None:
            held = torch.arange(level.width, device=state.device) if columns is None else columns
            final.index_copy_(2, held, state)
            columns, state = held[live], state.index_select(2, live)
        if state.shape[2] == 0:
            break
        if keep_states:
            trace.columns.append(columns)
            trace.states.append(state)
        params = gather_params(table, _level_ranks(lists, index, columns))
        state = job.kernels.forward(
            params,
            _take(origins, level.width, columns),
            state,
            _take(job.windows, level.width, columns),
        )
    if columns is None:
        final[..., : state.shape[2]] = state
    else:
        final.index_copy_(2, columns, state)
    return final, trace


class Composite(torch.autograd.Function):
    """(means2d, conics, colors, opacities, depths) -> planes [5, h, w]: transmittance, colour, depth.

    Memory for the backward pass: five planes per tile and chunk of K Gaussians, that is 5/K floats per
    fragment instead of the dozens that autograd would keep; everything else is computed again.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Float[Tensor, "n 2"],
        conics: Float[Tensor, "n 3"],
        colors: Float[Tensor, "m 3"],
        opacities: Float[Tensor, "n"],
        depths: Float[Tensor, "n"],
        job: Job,
    ) -> Float[Tensor, "5 h w"]:
        lists, grid = job.lists, job.lists.grid
        table = _parameter_table(job, means2d, conics, colors, opacities, depths)
        origins = torch.stack(grid.origins(lists.tiles, table.dtype))
        final, trace = _composite(job, table, origins, keep_states=any(ctx.needs_input_grad))
        planes = final.new_zeros((STATE_PLANES, grid.pixels_per_tile, grid.rows * grid.cols))
        planes[0] = 1.0
        planes[:, :, lists.tiles] = torch.cat((final[:1].abs(), final[1:]))
        ctx.job, ctx.columns, ctx.n = job, trace.columns, means2d.shape[0]
        ctx.save_for_backward(table, origins, final, *trace.states)
        return grid.to_image(planes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Float[Tensor, "5 h w"]) -> tuple[Tensor | None, ...]:
        job, lists = ctx.job, ctx.job.lists
        table, origins, final, *states = ctx.saved_tensors
        tiled = lists.grid.to_tiles(grad).index_select(2, lists.tiles)
        total = (final[1:] * tiled[1:]).sum(dim=0) + final[0].abs() * tiled[0]
        upstream = torch.cat((tiled[1:], total[None]))
        per_slot = _slot_gradients(job, table, origins, upstream, ctx.columns, states)
        sums = sum_bags(per_slot, lists.slots, lists.bags)
        means, conics, colors, opacities, depths = _to_parameters(table[:, :-1], sums)
        if job.absgrad_target is not None:
            target = job.absgrad_target
            target.absgrad = _spread(sums[:, GRADIENTS:], lists.rows, ctx.n)[None, : target.shape[1]]
        spread = (_spread(x, lists.rows, ctx.n) for x in (means, conics, opacities, depths))
        grad_means, grad_conics, grad_opacities, grad_depths = spread
        return grad_means, grad_conics, colors, grad_opacities, grad_depths, None


def _slot_gradients(job: Job, table, origins, upstream, all_columns, states) -> Float[Tensor, "s g"]:
    """The backward kernel's sums for every slot; 0 for slots that early stopping left out."""
    lists, absgrad = job.lists, job.absgrad_target is not None
    per_slot = table.new_zeros((lists.ranks.numel(), GRADIENTS + (2 if absgrad else 0)))
    for index, (columns, state) in enumerate(zip(all_columns, states, strict=True)):
        level = lists.levels[index]
        params = gather_params(table, _level_ranks(lists, index, columns))
        planes = (_take(x, level.width, columns) for x in (origins, upstream, job.windows))
        level_origins, level_upstream, level_window = planes
        sums = job.kernels.backward(params, level_origins, state, level_upstream, level_window, absgrad)
        by_slot = sums.view(sums.shape[0], -1).T
        if columns is None:
            per_slot[level.start : level.start + by_slot.shape[0]] = by_slot
        else:
            lanes = torch.arange(lists.chunk, device=columns.device) * level.width
            per_slot.index_copy_(0, (level.start + lanes[:, None] + columns).view(-1), by_slot)
    return per_slot


def sum_bags(
    values: Float[Tensor, "s g"], members: Int[Tensor, "q"], starts: Int[Tensor, "m"]
) -> Float[Tensor, "m g"]:
    """For each bag j the sum of values[members[starts[j] : starts[j + 1]]], in that order."""
    if starts.numel() == 0 or members.numel() == 0:
        return values.new_zeros((starts.numel(), values.shape[1]))
    if values.device.type in ("cpu", "cuda"):
        return F.embedding_bag(members, values, starts, mode="sum")
    ends = torch.cat((starts[1:], starts.new_tensor([members.numel()])))
    owner = torch.repeat_interleave(torch.arange(starts.numel(), device=starts.device), ends - starts)
    return values.new_zeros((starts.numel(), values.shape[1])).index_add_(0, owner, values[members])


def _to_parameters(table: Float[Tensor, "c m"], sums: Float[Tensor, "m g"]) -> tuple[Tensor, ...]:
    """Gradients of (means2d, conics, colors, opacities, depths) by rank, from the backward kernel's sums.

    sigma = (xx dx^2 + yy dy^2) / 2 + xy dx dy and alpha = opacity exp(-sigma), with d = mean - pixel.
    """
    _, _, xx, xy, yy, opacity = table[:MOMENTS]
    s, s_dx, s_dy, s_xx, s_xy, s_yy = sums[:, :MOMENTS].unbind(-1)
    means = torch.stack((xx * s_dx + xy * s_dy, xy * s_dx + yy * s_dy), dim=-1)
    conics = torch.stack((0.5 * s_xx, s_xy, 0.5 * s_yy), dim=-1)
    return means, conics, sums[:, MOMENTS : MOMENTS + 3], -s / opacity, sums[:, MOMENTS + 3]


def _spread(values: Tensor, rows: Int[Tensor, "m"], n: int) -> Tensor:
    """`values` by rank as [n, ...] by row, 0 for rows that were not drawn."""
    return values.new_zeros((n, *values.shape[1:])).index_copy_(0, rows, values)
