"""Puts a block into active parameters and Adam optimizers, and takes it out again, moments included."""

import math
from collections.abc import Mapping, MutableMapping

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from abcd_ns.engine.gaussians.adam import Adam
from abcd_ns.engine.gaussians.block_state import MOMENTS, BlockState, Clocks
from abcd_ns.engine.types import PARAM_NAMES, Gaussians

Params = MutableMapping[str, Parameter] | ParameterDict
"""The active parameters by name."""
Optimizers = Mapping[str, torch.optim.Optimizer]
"""One Adam per parameter, under the parameter's name; each with one parameter group."""
LEARNING_RATES = {
    "means": 1.6e-4,
    "features_dc": 0.0025,
    "features_rest": 0.0025 / 20,
    "opacities": 0.05,
    "scales": 0.005,
    "quats": 0.001,
}
"""Splatfacto's. The means' is in the reach of views, see View, and decays with the progress of the run."""
RATED_FOR = 10_000
"""Steps after which a block is trained with these rates, which are made for 30,000."""
UNDER_TRAINED_RATES = 4.0
"""Times as large they are before, at most; a step of four views is as large as that by itself."""
LATE_RATE = 3.0
"""Times as large is that of harmonics which come late, as they have half of a run at most."""

PINNED_BYTES = 256 << 20
"""Of RAM that is pinned to copy a block from a GPU, at most: torch gives none of it back."""
STEP_PARTS = 128
"""Adam's step count is a multiple of 1 over this, which float32 counts exactly to beyond 100,000."""


def attach(state: BlockState, params: Params, optimizers: Optimizers, *, batch: int = 1) -> None:
    """Make `state` the active block: new Parameters, with its moments as Adam's state.

    The Parameters that were active before lose their memory at once, even where something (a logged loss,
    say) still refers to them. Each of the steps to come has `batch` views, see `Pace.set`.
    """
    for name, value in state.gaussians.items():
        parameter = Parameter(value.detach().clone())
        group = optimizers[name].param_groups[0]
        before = group["params"][0]
        optimizers[name].state.pop(before, None)
        before.grad, before.data = None, before.data.new_empty(0)
        group["params"] = [parameter]
        optimizers[name].state[parameter] = {
            "step": adam_step(state.clocks, batch).to(value.device),  # fused Adam reads it there
            **{moment: getattr(getattr(state, moment), name).clone() for moment in MOMENTS},
        }
        params[name] = parameter


def raise_degree(params: Params, optimizers: Optimizers, sh_degree: int) -> None:
    """Give the active block room for spherical harmonics of this degree, which begin as zeros; none go."""
    name = "features_rest"
    before, more = params[name], (sh_degree + 1) ** 2 - 1 - params[name].shape[1]
    if more <= 0:
        return
    after = Parameter(F.pad(before.detach(), (0, 0, 0, more)))
    adam = optimizers[name].state.pop(before)
    adam |= {moment: F.pad(adam[moment], (0, 0, 0, more)) for moment in MOMENTS}
    adam["step"] = optimizers["means"].state[params["means"]]["step"].clone()  # it skips what is empty
    optimizers[name].param_groups[0]["params"] = [after]
    optimizers[name].state[after] = adam
    params[name] = after


def detach(params: Params, optimizers: Optimizers, growth: dict[str, Tensor], clocks: Clocks) -> BlockState:
    """The active block as a BlockState on the CPU, which shares no memory with later steps. It stays active.

    From a GPU up to PINNED_BYTES of the copies are in pinned memory. That is not for keeping: what is
    persisted is copied once more. Density control's statistics in `growth`, each [n], are copied, too.
    """
    adam = {name: optimizers[name].state[params[name]] for name in PARAM_NAMES}
    moments = [adam[name][moment] for moment in MOMENTS for name in PARAM_NAMES]
    copies = iter(_on_cpu([*(params[name] for name in PARAM_NAMES), *moments, *growth.values()]))
    parts = [Gaussians(**{name: next(copies) for name in PARAM_NAMES}) for _ in ("", *MOMENTS)]
    return BlockState(*parts, {name: next(copies) for name in growth}, clocks)


def _on_cpu(values: list[Tensor]) -> list[Tensor]:
    """Copies of tensors of one device. Those in pinned RAM are waited for once: the last comes when all have.
    The others, for which PINNED_BYTES do not suffice, are waited for one by one."""
    copies, room = [], PINNED_BYTES
    for k, value in enumerate(values):
        pinned = 1 << (value.nbytes - 1).bit_length() if value.nbytes else 0  # torch rounds up so
        is_late = k + 1 < len(values) and pinned <= room
        room -= pinned if is_late else 0
        copies.append(value.detach().to("cpu", copy=True, non_blocking=is_late))
    return copies


def adam_step(clocks: Clocks, batch: int) -> Float[Tensor, ""]:
    """Steps of `batch` views that would have let the moments forget as much as they have.

    Adam divides its moments by 1 - beta**step, with the beta of the present steps: so `step` counts these,
    and may be a fraction. It is rounded, so that a run that is resumed in the middle of a visit counts the
    same.
    """
    return torch.tensor(round(clocks.adam_views * STEP_PARTS / batch) / STEP_PARTS, dtype=torch.float32)


def active_gaussians(params: Params) -> Gaussians:
    """The active parameters as Gaussians, with their gradients' graph."""
    return Gaussians(**{name: params[name] for name in PARAM_NAMES})


def nothing_active(sh_degree: int, device: torch.device | str = "cpu") -> tuple[Params, Optimizers]:
    """Empty parameters and one Adam for each, as 3DGS uses it, for a run without nerfstudio."""
    empty = Gaussians.empty(sh_degree, device)
    params = {name: Parameter(value) for name, value in empty.items()}
    optimizers = {
        name: Adam([value], lr=LEARNING_RATES[name], eps=1e-15, fused=True) for name, value in params.items()
    }
    return params, optimizers


class Pace:
    """Learning rates and memories of the optimizers, as they were given for steps of one view each. With
    `fast_start` rates are larger while a block has had few steps, see `rates_of_under_trained`. Harmonics may
    be `late`, see LATE_RATE."""

    def __init__(self, optimizers: Optimizers, fast_start: bool, late: bool = False) -> None:
        groups = {name: optimizer.param_groups[0] for name, optimizer in optimizers.items()}
        self._optimizers, self._fast_start = optimizers, fast_start
        self._given = {name: (group["lr"], group["betas"]) for name, group in groups.items()}
        if late:
            rate, betas = self._given["features_rest"]
            self._given["features_rest"] = LATE_RATE * rate, betas

    def set(self, batch: int, trained: int, means_decay: float, damping: float = 1.0) -> None:
        """For a step of `batch` views on a block that was trained on so many, with the means' rate at a share
        of what was given, and all of them damped.

        Rates grow in proportion to the views, as a block's views agree on it, and moments forget as many
        views' worth a step (Malladi et al. 2022, "On the SDEs and scaling rules for adaptive gradient
        algorithms", have the square root, for gradients that are noise).
        """
        share = damping * (rates_of_under_trained(trained, batch) if self._fast_start else 1.0)
        for name, (rate, betas) in self._given.items():
            group = self._optimizers[name].param_groups[0]
            decay = means_decay if name == "means" else 1.0
            group["lr"] = rate * decay * batch * share
            group["betas"] = tuple(beta**batch for beta in betas)


def rates_of_under_trained(views: int, batch: int) -> float:
    """By how much learning rates are larger for a block that was trained on so many views yet.

    A step of Adam moves a parameter by about its rate, whatever the gradient: how far a block gets in T steps
    is bounded by rate x T. So few steps take larger rates, which fall with the root of their number until
    they are those that steps of `batch` views have.
    """
    steps = max(views, 1) / batch
    return max(min(math.sqrt(RATED_FOR / steps), UNDER_TRAINED_RATES) / batch, 1.0)
