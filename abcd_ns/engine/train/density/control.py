"""Growing and pruning the active block, on the block's own clock.

The default strategy is 3DGS's, judged by AbsGS's gradients, but for how one Gaussian becomes two (see
`growing`); MCMC is gsplat's own. gsplat's strategies keep a schedule in absolute steps of one global run.
Here the schedule is in shares of the run and in the block's own steps, so it is kept in this file.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Literal

import torch
from gsplat.strategy import MCMCStrategy
from gsplat.strategy import ops as gsplat_ops
from torch import Tensor

from abcd_ns.engine.gaussians.param_swap import Optimizers, Params
from abcd_ns.engine.render.cuda import fused
from abcd_ns.engine.render.primitive import SPLATS, Primitive
from abcd_ns.engine.render.splat_kernels import MIN_ALPHA
from abcd_ns.engine.train.density.clock import DensityClock
from abcd_ns.engine.train.density.growing import chosen, halve
from abcd_ns.engine.train.density.relocation import binomials, compute_relocation
from abcd_ns.engine.train.density.shedding import (
    FAINT,
    LAST,
    WEIGHED,
    are_weighed,
    fills,
    haze,
    may_grow,
    risen,
    weigh,
)

GATHER, REFINE = 1, 6
"""Step numbers as gsplat's MCMC sees them; it refines on multiples of the second."""

GRADIENTS = ("grad2d", "count")
"""What gsplat's default strategy adds up for each Gaussian, under its names."""
REFINE_UNTIL, RESET_UNTIL = 0.5, 0.4
"""Share of a visit among others after which none is refined; of a warm-up after which no opacity is reset."""
WARM_UP_EVERY, LEAST_EVERY = 1 / 60, 30
"""A warm-up is refined whenever this share has been drawn of the views that the run would draw at its pace,
or so many views if these are more, or all of the scene's: also a short one is to fill its room, but by what
every view asks for."""
MOST_NEW = 0.1
"""Gaussians that one refinement may add, as a share of the block's; at least one."""
PLAIN_GRADIENT = 0.25
"""Thresholds of gradients, as a share of those of absolute ones: 0.0002 (3DGS, 2DGS) of 0.0008 (AbsGS)."""
MCMC_MIN_OPACITY = 0.005
MCMC_DEFAULT_CAP = 1_000_000
MCMC_NOISE_LR = 5e5
"""Strength of the exploration noise."""
MCMC_OPACITY_REG, MCMC_SCALE_REG = 0.01, 0.01
"""Weights of the mean opacity and of the mean standard deviation in the loss."""


Infos = tuple[dict[str, Any], ...]
"""gsplat's `info` of one or more drawings."""


@dataclass
class DensityConfig:
    """When and how the number of Gaussians changes. Thresholds are splatfacto's but that of opacities."""

    strategy: Literal["default", "mcmc", "off"] = "default"
    """`default`: make two of one by gradient, and prune. `mcmc`: relocate, and add up to a limit."""
    refine_start: float = 1 / 60
    """Share of the run before the first refinement (500 of 30,000 steps in splatfacto)."""
    refine_stop: float = 0.5
    """Share of the run after which none becomes two; a block grows in its first visit all the same,
    unless that is in the last third. Who fills less than the `price` goes later, too."""
    refine_every: int = 100
    """Views drawn to train a block between its refinements; never fewer than show the block, but half of a
    first visit's at most, and in the warm-up a sixtieth of the run's, if no fewer than show the scene."""
    reset_every: int = 3000
    """Views drawn between opacity resets of a block without others, and in the first part of a warm-up
    (`default` strategy); 0 means never."""
    cull_alpha_thresh: float = 0.005
    """Opacity under which a Gaussian is pruned (`default` strategy)."""
    densify_grad_thresh: float = 0.0008
    """Mean norm of the screen-space gradient over which a Gaussian becomes two."""
    use_absgrad: bool = True
    """Judge by the sum of absolute per-pixel gradients (AbsGS) rather than by their sum. Surfels have no such
    sums: they are judged by a quarter of the threshold."""
    price: float = 8.0
    """Pixels that a Gaussian must fill (sum of alpha T) in all views of its block together, once growth ends;
    those that fill less go, and those that fill less than four times as many do not grow (`default`
    strategy). 0 keeps everything, haze too, and whatever a complete run could spare (`mcmc` as well)."""
    max_gaussians: int = 0
    """Gaussians in the whole scene at most; 0 means no limit (`mcmc`: 1,000,000). Where there are more points
    to begin with, a random choice of them begins."""

    @property
    def limit(self) -> int | None:
        """Gaussians in the whole scene at most, or None."""
        if self.max_gaussians > 0:
            return self.max_gaussians
        return MCMC_DEFAULT_CAP if self.strategy == "mcmc" else None


def for_primitive(config: DensityConfig, primitive: Primitive) -> DensityConfig:
    """The options where Gaussians are of a primitive."""
    if not config.use_absgrad or primitive.has_absgrad:
        return config
    plain = config.densify_grad_thresh * PLAIN_GRADIENT
    return replace(config, use_absgrad=False, densify_grad_thresh=plain)


class DensityControl:
    """Applies the configured strategy to the live block."""

    def __init__(self, config: DensityConfig, primitive: Primitive = SPLATS) -> None:
        self.config, self._axes = for_primitive(config, primitive), primitive.axes
        self._binomials = binomials()

    @property
    def absgrad(self) -> bool:
        """Whether the rasterizer must leave `absgrad` on `means2d`."""
        return self.config.strategy == "default" and self.config.use_absgrad

    @property
    def weighs(self) -> bool:
        """Whether the rasterizer must leave `weights`."""
        return self.config.strategy == "default" and self.config.price > 0

    def before_backward(self, infos: Infos) -> None:
        """Keep the gradient of the projected means, by which the default strategy judges."""
        for info in infos:
            if self.config.strategy == "default" and info["means2d"].requires_grad and not self.absgrad:
                info["means2d"].retain_grad()

    def regularisation(self, params: Params, scene_gaussians: int) -> Tensor:
        """The terms which `mcmc` adds to the loss: means over the scene, of which the block is a part."""
        if self.config.strategy != "mcmc":
            return params["means"].new_zeros(())
        opacity = torch.sigmoid(params["opacities"]).sum()
        scale = torch.exp(params["scales"]).sum() / 3
        return (MCMC_OPACITY_REG * opacity + MCMC_SCALE_REG * scale) / max(scene_gaussians, 1)

    def is_due(self, clock: DensityClock) -> bool:
        """Whether this step refines."""
        begins, ends = self.config.refine_start, self.config.refine_stop
        if clock.first and begins < ends:
            ends = max(ends, LAST)
        if not begins <= clock.progress < ends:
            return False
        views = clock.views if clock.visit is None else min(clock.views, clock.visit)
        every = max(self.config.refine_every, views, 1)
        if clock.first and clock.visit is not None:  # what it was refined at before is the warm-up's
            every = min(every, max(int(REFINE_UNTIL * clock.visit) - clock.taken, 1))
        if clock.refined is None:
            return clock.reached(every)
        if clock.warm_up:
            every = min(every, max(LEAST_EVERY, views, round(WARM_UP_EVERY * clock.pace)))
        elif clock.spent > REFINE_UNTIL:
            return False
        return clock.steps - clock.refined >= every

    def refines(self, clock: DensityClock, infos: Infos) -> bool:
        """Whether this step refines: it is due, and where gradients decide there are any.

        Args:
            infos: of the step's drawings, after backward.
        """
        return self.is_due(clock) and (self.config.strategy != "default" or bool(self._with_gradient(infos)))

    def resets(self, clock: DensityClock) -> bool:
        """Whether this step resets opacities (`default` strategy); that needs no gradients. Among others
        never: shedding finds there what resets are made to find."""
        every = self.config.reset_every
        if self.config.strategy != "default" or every <= 0 or clock.progress >= self.config.refine_stop:
            return False
        alone = clock.refined is None or clock.warm_up
        return alone and clock.spent <= RESET_UNTIL and clock.reached(every)

    def count(self, means: Tensor, infos: Infos, views: int) -> dict[str, Tensor]:
        """What drawings add to a block's statistics, after backward; by name, each [n].

        Args:
            means: of the block, [n, 3].
            views: that the block is trained on.
        """
        if self.config.strategy != "default":
            return {}
        with_gradient = self._with_gradient(infos)
        if not with_gradient or len(means) == 0:
            return {}
        drawings = [each for info in with_gradient for each in zip(*self._norms(info), strict=True)]
        norms, seen = (reduce(torch.add, parts) for parts in zip(*drawings, strict=True))
        return {**dict(zip(GRADIENTS, (norms, seen), strict=True)), **weigh(with_gradient, views)}

    def _gathered(
        self, growth: dict[str, Tensor], means: Tensor, infos: Infos, views: int
    ) -> dict[str, Tensor]:
        """Statistics with those of more drawings, see `count`; on CUDA in one kernel for each of `infos`."""
        names = (*GRADIENTS, *WEIGHED)
        if not self.weighs or any("weights" not in i or i["weights"].grad is None for i in infos):
            return added(growth, self.count(means, infos, views))
        for info in infos:
            sums = [growth[name] if name in growth else torch.zeros_like(means[:, 0]) for name in names]
            weights = info["weights"].grad
            drawn = self._gradient(info), info["radii"], weights
            scale, share = self._scale(info), len(weights) / views
            of_one_size = not isinstance(scale[0], Tensor)
            found = fused.statistics(*drawn, sums, scale, share) if of_one_size else None
            if found is None:
                return added(growth, self.count(means, infos, views))
            growth = {**growth, **dict(zip(names, found, strict=True))}
        return growth

    def _gradient(self, info: dict[str, Any]) -> Tensor | None:
        means2d = info["means2d"]
        return getattr(means2d, "absgrad", None) if self.absgrad else means2d.grad

    def _with_gradient(self, infos: Infos) -> Infos:
        return tuple(info for info in infos if self._gradient(info) is not None)

    @staticmethod
    def _scale(info: dict[str, Any]) -> tuple[float | Tensor, float | Tensor]:
        """Of a gradient, along both axes: from pixels to halves of the image, for the sum of drawings; [v, 1]
        where views have several sizes."""
        return tuple(info[side] / 2.0 * info["n_cameras"] for side in ("width", "height"))

    def _norms(self, info: dict[str, Any]) -> tuple[Tensor, Tensor]:
        """What DefaultStrategy._update_state adds up: norms of the gradients in each view, and 1 where there
        is one, [v, n]. It picks rows, whose number the host has to wait for; here the others are 0.
        """
        gradient, (width, height) = self._gradient(info), self._scale(info)
        norms = torch.stack((gradient[..., 0] * width, gradient[..., 1] * height), dim=-1).norm(dim=-1)
        # An accelerator may have skipped the step that these are of.
        seen = (info["radii"] > 0) & norms.isfinite()
        return torch.where(seen, norms, 0.0), seen.to(norms.dtype)

    def after_step(
        self,
        params: Params,
        optimizers: Optimizers,
        growth: dict[str, Tensor],
        infos: Infos,
        clock: DensityClock,
    ) -> dict[str, Tensor]:
        """Gather statistics and, when it is time, refine. Call after Adam's step.

        Args:
            growth: the block's statistics so far, each [n].
            infos: of the step's drawings, after backward.

        Returns:
            The block's statistics from now on. The global random generator is left as it was.
        """
        if self.config.strategy == "off" or len(params["means"]) == 0:
            return growth
        if self.config.strategy == "default":
            infos = self._with_gradient(infos)
            growth = self._gathered(growth, params["means"], infos, clock.views)
            if not (self.refines(clock, infos) or self.resets(clock)):
                return growth
        device = params["means"].device
        cuda = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(devices=cuda), _operators_for(device):
            torch.manual_seed(clock.seed)
            if self.config.strategy == "mcmc":
                self._step_mcmc(params, optimizers, clock)
                return {}
            return self._step_default(params, optimizers, growth, infos, clock)

    def shed(
        self,
        params: Params,
        optimizers: Optimizers,
        growth: dict[str, Tensor],
        progress: float,
    ) -> dict[str, Tensor]:
        """Take out what fills too little of the block's views, at a share of the run; haze; and what is too
        faint for any picture to show, which nothing would train again.

        Returns:
            The block's statistics from now on.
        """
        if not self.weighs or not are_weighed(growth):
            return growth
        price, faint = (risen(each, progress, self.config.refine_stop) for each in (self.config.price, FAINT))
        opacities = torch.sigmoid(params["opacities"][:, 0])
        drop = (fills(growth) <= price) | (opacities < MIN_ALPHA) | haze(growth, opacities, faint)
        growth = dict(growth)  # rows are taken out of it
        if bool(drop.any()):
            gsplat_ops.remove(params, optimizers, growth, drop)
        return growth

    def _step_default(
        self,
        params: Params,
        optimizers: Optimizers,
        growth: dict[str, Tensor],
        infos: Infos,
        clock: DensityClock,
    ) -> dict[str, Tensor]:
        config = self.config
        if self.refines(clock, infos):
            gradients = growth["grad2d"] / growth["count"].clamp_min(1)
            wanted = torch.where(gradients > config.densify_grad_thresh, gradients, 0.0)
            most = math.ceil(MOST_NEW * len(wanted))
            room = most if clock.room is None else min(most, clock.room)
            which = chosen(torch.where(may_grow(growth, config.price), wanted, 0.0), room)
            growth = halve(params, optimizers, growth, which, self._axes)
            growth |= {name: torch.zeros_like(growth[name]) for name in GRADIENTS}
            faint = torch.sigmoid(params["opacities"][:, 0]) < config.cull_alpha_thresh
            if bool(faint.any()):
                gsplat_ops.remove(params, optimizers, growth, faint)
        if self.resets(clock):
            gsplat_ops.reset_opa(params, optimizers, {}, value=2 * config.cull_alpha_thresh)
        return growth

    def _step_mcmc(self, params: Params, optimizers: Optimizers, clock: DensityClock) -> None:
        room = len(params["means"]) if clock.room is None else clock.room
        strategy = MCMCStrategy(
            cap_max=len(params["means"]) + max(room, 0),
            noise_lr=MCMC_NOISE_LR,
            refine_start_iter=0,
            refine_every=REFINE,
            min_opacity=MCMC_MIN_OPACITY,
        )
        # gsplat puts the dead where some are alive, and fails where none is.
        alive = self.is_due(clock) and bool((params["opacities"].sigmoid() > MCMC_MIN_OPACITY).any())
        step = REFINE if alive else GATHER
        learning_rate = optimizers["means"].param_groups[0]["lr"]
        self._binomials = self._binomials.to(params["means"].device)
        strategy.step_post_backward(
            params, optimizers, {"binoms": self._binomials}, step, {}, lr=learning_rate
        )


def added(growth: Mapping[str, Tensor], more: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Statistics of more drawings added to a block's."""
    sums = {name: growth[name] + value if name in growth else value for name, value in more.items()}
    return {**growth, **sums}


@contextmanager
def _operators_for(device: torch.device) -> Iterator[None]:
    """gsplat 1.4.0's MCMC calls two CUDA operators by name; elsewhere, lend it torch ones for the call. And
    it gives back the allocator's memory after each refinement, only to ask for it anew: it had better not."""
    lent: list[tuple[Any, str, Any]] = [(torch.cuda, "empty_cache", lambda: None)]
    if device.type != "cuda":
        from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci  # private: asked of nobody else

        lent.append((gsplat_ops, "compute_relocation", compute_relocation))
        lent.append((gsplat_ops, "quat_scale_to_covar_preci", _quat_scale_to_covar_preci))
    originals = [(owner, name, getattr(owner, name)) for owner, name, _ in lent]
    try:
        for each in lent:
            setattr(*each)
        yield
    finally:
        for each in originals:
            setattr(*each)
