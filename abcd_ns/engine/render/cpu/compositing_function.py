"""Alpha compositing of projected Gaussians as one differentiable function of bounded memory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.render.cpu.binning import Level, TileLists
from abcd_ns.engine.render.cpu.chunk_kernels import ChunkKernels
from abcd_ns.engine.render.cpu.torch_kernels import STATE_PLANES, gather_params, median_chunk

COMPACT = 0.75
"""Tiles whose pixels are all finished are dropped once fewer than this share is left."""


@dataclass
class Job:
    """All that a drawing needs besides tensors that take gradients."""

    lists: TileLists
    splats: int
    """How many there are in all, drawn or not."""
    kernels: ChunkKernels
    absgrad_target: Tensor | None
    """Gets an attribute `absgrad` in the backward pass: means2d [v, n, 2] of the first v n splats. None where
    the primitive has no such sums."""


class _Drawn(NamedTuple):
    """A level of a group of tiles, as it was drawn."""

    level: Level
    columns: Tensor | None
    """Which of its columns; None means all."""
    state: Tensor
    """Before it."""


def _initial_state(lists: TileLists, dtype: torch.dtype) -> Float[Tensor, "5 p a"]:
    sheet, device = lists.sheet, lists.tiles.device
    crops = [grid.crop for grid in sheet.grids]
    inside = [torch.ones((1, crop.height, crop.width), device=device, dtype=dtype) for crop in crops]
    state = inside[0].new_zeros((STATE_PLANES, sheet.pixels_per_tile, lists.tiles.numel()))
    state[0] = sheet.to_tiles(inside, fill=-1.0)[0].index_select(1, lists.tiles)
    return state


def _live_columns(state: Float[Tensor, "s p a"]) -> Int[Tensor, "b"] | None:
    """The columns with an unfinished pixel, if dropping the others is worth it."""
    live = (state[0] > 0).any(dim=0).nonzero()[:, 0]
    return live if live.numel() < COMPACT * state.shape[2] else None


def _level_ranks(lists: TileLists, level: Level, columns: Tensor | None) -> Int[Tensor, "k a"]:
    ranks = lists.ranks[level.start : level.start + lists.chunk * level.width].view(lists.chunk, level.width)
    return ranks if columns is None else ranks.index_select(1, columns)


def _take(planes: Tensor, level: Level, columns: Tensor | None) -> Tensor:
    """The columns of a level from planes [..., a] that hold all tiles' columns."""
    planes = planes[..., level.first : level.first + level.width]
    return planes.contiguous() if columns is None else planes.index_select(-1, columns)


DrawChunk = Callable[[Level, Tensor | None, Float[Tensor, "s p a"]], Float[Tensor, "s p a"]]
"""(level, columns, state) -> the state after that level's chunk; no columns are all of the level's."""


def _walk(lists: TileLists, state: Float[Tensor, "s p a"], draw: DrawChunk) -> Float[Tensor, "s p a"]:
    """All groups, one after the other. Returns the last states."""
    states = [_walk_group(levels, _take(state, levels[0], None), draw) for levels in lists.groups]
    return torch.cat(states, dim=2) if states else state


def _walk_group(
    levels: Sequence[Level], state: Float[Tensor, "s p a"], draw: DrawChunk
) -> Float[Tensor, "s p a"]:
    """A group's levels front to back, for as long as a tile has unfinished pixels."""
    columns, final, width = None, state.clone(), state.shape[2]
    for level in levels:
        if columns is not None and level.width < width:
            keep = int((columns < level.width).sum())
            final.index_copy_(2, columns[keep:], state[..., keep:])
            columns, state = columns[:keep], state[..., :keep].contiguous()
        elif level.width < state.shape[2]:
            final[..., level.width : state.shape[2]] = state[..., level.width :]
            state = state[..., : level.width].contiguous()
        width = level.width
        live = _live_columns(state)
        if live is not None:
            held = torch.arange(width, device=state.device) if columns is None else columns
            final.index_copy_(2, held, state)
            columns, state = held[live], state.index_select(2, live)
        if state.shape[2] == 0:
            break
        state = draw(level, columns, state)
    if columns is None:
        final[..., : state.shape[2]] = state
    else:
        final.index_copy_(2, columns, state)
    return final


def _draw_level(
    job: Job,
    table: Tensor,
    origins: Float[Tensor, "2 a"],
    trace: list[_Drawn] | None,
    level: Level,
    columns: Tensor | None,
    state: Tensor,
) -> Tensor:
    """A DrawChunk that draws, and notes in `trace` what it draws on."""
    if trace is not None:
        trace.append(_Drawn(level, columns, state))
    params = gather_params(table, _level_ranks(job.lists, level, columns))
    return job.kernels.forward(params, _take(origins, level, columns), state)


class Composite(torch.autograd.Function):
    """Drawn Gaussians by rank [d, m] -> planes [5, p, t] of all tiles: transmittance, colour, depth.

    Rows are the GRADED ones of a primitive. Memory for the backward pass: five planes per tile and chunk
    of K Gaussians, that is 5/K floats per fragment instead of the dozens that autograd would keep; everything
    else is computed again.
    """

    @staticmethod
    def forward(ctx: Any, drawn: Float[Tensor, "d m"], job: Job) -> Float[Tensor, "5 p t"]:
        lists, sheet = job.lists, job.lists.sheet
        table, origins = _table(drawn, job)
        trace = list[_Drawn]()
        # Not a closure: where shapes are checked, the checks of one are made anew at every drawing.
        draw = partial(_draw_level, job, table, origins, trace if any(ctx.needs_input_grad) else None)
        final = _walk(lists, _initial_state(lists, table.dtype), draw)
        planes = final.new_zeros((STATE_PLANES, sheet.pixels_per_tile, sheet.tiles))
        planes[0] = 1.0
        planes.index_copy_(2, lists.tiles, torch.cat((final[:1].abs(), final[1:])))
        ctx.job, ctx.drawn = job, [(level.level, level.columns) for level in trace]
        ctx.save_for_backward(drawn, table, origins, final, *(level.state for level in trace))
        return planes

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Float[Tensor, "5 p t"]) -> tuple[Float[Tensor, "d m"], None]:
        job, lists, fragments = ctx.job, ctx.job.lists, ctx.job.kernels.fragments
        drawn, table, origins, final, *states = ctx.saved_tensors
        tiled = grad.index_select(2, lists.tiles)
        total = (final[1:] * tiled[1:]).sum(dim=0) + final[0].abs() * tiled[0]
        upstream = torch.cat((tiled[1:], total[None]))
        trace = [_Drawn(*level, state) for level, state in zip(ctx.drawn, states, strict=True)]
        per_slot = _slot_gradients(job, table, origins, upstream, trace)
        sums = sum_bags(per_slot, lists.slots, lists.bags)
        if job.absgrad_target is not None:
            target = job.absgrad_target
            absolute = sums.new_zeros((job.splats, 2)).index_copy_(0, lists.rows, sums[:, -2:])
            target.absgrad = absolute[: target.shape[0] * target.shape[1]].view_as(target)
        return fragments.to_drawn(drawn, sums), None


def _slot_gradients(
    job: Job, table: Tensor, origins: Tensor, upstream: Tensor, trace: list[_Drawn]
) -> Float[Tensor, "s g"]:
    """The backward kernel's sums for every slot; 0 for slots that early stopping left out."""
    lists = job.lists
    kept = job.kernels.fragments.gradients + (0 if job.absgrad_target is None else 2)
    per_slot = table.new_zeros((lists.ranks.numel(), kept))
    for level, columns, state in trace:
        params = gather_params(table, _level_ranks(lists, level, columns))
        level_origins, level_upstream = (_take(x, level, columns) for x in (origins, upstream))
        sums = job.kernels.backward(params, level_origins, state, level_upstream)
        _put(per_slot, level, columns, sums[:kept].reshape(kept, -1).T)
    return per_slot


def _put(per_slot: Tensor, level: Level, columns: Tensor | None, by_slot: Tensor) -> None:
    """Write what a level's chunk gave for some columns to their slots."""
    if columns is None:
        per_slot[level.start : level.start + by_slot.shape[0]] = by_slot
    else:
        lanes = torch.arange(by_slot.shape[0] // columns.numel(), device=columns.device) * level.width
        per_slot.index_copy_(0, (level.start + lanes[:, None] + columns).view(-1), by_slot)


def pair_weights(drawn: Float[Tensor, "d m"], job: Job) -> Float[Tensor, "q"]:
    """For each pair of the job's lists the sum of the Gaussian's weight alpha T over the tile's pixels."""
    lists = job.lists
    table, origins = _table(drawn, job)
    table = table[: job.kernels.fragments.opacity + 1]
    per_slot = table.new_zeros(lists.ranks.numel())
    _walk(lists, _initial_state(lists, table.dtype)[:1], partial(_weigh_level, job, table, origins, per_slot))
    return per_slot[lists.slots]


def _weigh_level(
    job: Job,
    table: Tensor,
    origins: Float[Tensor, "2 a"],
    per_slot: Tensor,
    level: Level,
    columns: Tensor | None,
    state: Tensor,
) -> Tensor:
    """A DrawChunk that writes weights to `per_slot`."""
    params = gather_params(table, _level_ranks(job.lists, level, columns))
    state, weights = job.kernels.weigh(params, _take(origins, level, columns), state)
    _put(per_slot, level, columns, weights.reshape(-1))
    return state


def deepen(drawn: Float[Tensor, "d m"], job: Job, state: Float[Tensor, "2 p t"]) -> Float[Tensor, "2 p t"]:
    """Transmittance and median depth of all tiles, see `median_chunk`, behind those of what is in front."""
    lists, fragments = job.lists, job.kernels.fragments
    table, origins = _table(drawn, job)
    table = table[: fragments.opacity + 1]
    after = state.clone()
    deepen_level = partial(_deepen_level, job, table, origins)
    after[:, :, lists.tiles] = _walk(lists, state.index_select(2, lists.tiles), deepen_level)
    return after


def _deepen_level(
    job: Job,
    table: Tensor,
    origins: Float[Tensor, "2 a"],
    level: Level,
    columns: Tensor | None,
    before: Tensor,
) -> Tensor:
    """A DrawChunk of `deepen`'s states."""
    lists, fragments = job.lists, job.kernels.fragments
    params = gather_params(table, _level_ranks(lists, level, columns))
    return median_chunk(fragments, lists.sheet.side, params, _take(origins, level, columns), before)


def _table(drawn: Float[Tensor, "d m"], job: Job) -> tuple[Float[Tensor, "c n"], Float[Tensor, "2 a"]]:
    """What is drawn, with a last column of opacity 0 for empty slots, and the tiles' corners."""
    table = F.pad(job.kernels.fragments.table(drawn), (0, 1))
    return table, job.lists.sheet.origins(table).index_select(1, job.lists.tiles)


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
