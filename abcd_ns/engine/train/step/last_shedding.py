"""A last shedding: when a run is complete, what its pictures hardly miss is taken out.

Shedding in training (density/shedding) ends while there is time to make good what is missed, so that there
is more in a scene at its end than its pictures need. RadSplat (Niemeyer et al., 2024), LightGaussian (Fan et
al., NeurIPS 2024) and Speedy-Splat (Hanson et al., CVPR 2025) leave out a given share of what ranks lowest.
Here the pictures say how much: as many go as training views can spare.

A pixel is linear in each Gaussian's opacity, so that without the Gaussian it changes by o dC/do. Adam's
second moment of the logit of o is the mean square over steps of o (1 - o) <r, dC/do>, where r, the loss by
the picture, is hardly more than a sign in each pixel: over (1 - o)^2 it tells of the sum of squared changes,
for nothing and from all views. Times the pixels that the Gaussian fills, it ranks better than either alone.
"""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import ShedAtEnd, Shedding
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.store.settle import inbox_without, with_mail
from abcd_ns.engine.train.density.shedding import WEIGHED
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.train.step.whole_views import WholeViews
from abcd_ns.engine.types import Gaussians, View

LOSS = 0.05
"""Of the mean PSNR of training views, dB, that it may cost."""
MOST_VIEWS, FEWEST_VIEWS = 32, 4
"""That tell how much may go."""
STEPS_EACH = 100
"""Of a short run, for each of these views: drawing them again and again is to take 3% of its time at most."""
MOST = 0.5
"""Share of the Gaussians that may go."""
ROUNDS = 6
"""In each of which as many may go as halves what is between too few and too many."""
LEAST_ERROR = 1e-10
"""Mean squared difference below which a picture is its photo."""


def rank(state: BlockState, views: int) -> Float[Tensor, "n"]:
    """By how much a block's Gaussians would be missed, in no unit; infinite for who was never weighed.

    Args:
        views: that see the block.
    """
    if any(name not in state.growth for name in WEIGHED):
        return torch.full((len(state),), torch.inf)
    weight, looks = (state.growth[name] for name in WEIGHED)
    through = torch.sigmoid(-state.gaussians.opacities).clamp_min(1e-6)
    change = (state.exp_avg_sq.opacities / through.square()).flatten()
    return torch.where(looks > 0, views**2 * change * weight / looks, torch.inf)


class Without:
    """A scene at rest without those of its Gaussians that rank no higher than a price.

    Args:
        ranks: by block, of those that are seen, in their order.
    """

    def __init__(self, scene: BlockScene, ranks: Sequence[Float[Tensor, "_n"]], price: float) -> None:
        self.tree = scene.tree
        self._scene, self._stays = scene, [of_block > price for of_block in ranks]

    def gaussians(self, block: int) -> Gaussians:
        return self._scene.gaussians(block)[self._stays[block]]

    def version(self, block: int) -> int:
        return self._scene.version(block)

    def count(self, block: int) -> int:
        return int(self._stays[block].sum())

    def bounds(self, block: int) -> Box | None:
        """Of all: who is left is within them."""
        return self._scene.bounds(block)


class LastShedding:
    """Takes out of a run's scene, all of it at rest, as many Gaussians as cost LOSS at most.

    Args:
        target: gives what a sample should show.
    """

    def __init__(self, run: TrainingRun, target: Callable[[Sample], Target]) -> None:
        self._run, self._whole = run, WholeViews(run, target)
        self._seen: list[Tensor] = []
        """By block, the ranks of those that are drawn."""

    @property
    def is_wanted(self) -> bool:
        """Whether Gaussians have a price: nothing else weighs them."""
        return self._run.density.weighs

    @torch.no_grad()
    def take(self) -> None:
        """Do it; tells listeners how many went, and at what cost."""
        run = self._run
        blocks = range(run.scene.tree.num_blocks)
        ranks = [self._rank(block) for block in blocks]
        ranked = torch.cat(self._seen)
        ranked = ranked[ranked.isfinite()].sort().values
        if len(ranked) == 0:
            return
        views = self._views()
        self.announce(0)
        before = after = self._psnr(views, -1.0)
        few, many, price = 0, int(MOST * len(ranked)), -1.0
        for taken in range(1, ROUNDS + 1):
            self.announce(taken)
            if (middle := (few + many) // 2) == few:
                break
            tried = float(ranked[middle - 1])
            found = self._psnr(views, tried)
            if before - found <= LOSS:
                few, price, after = middle, tried, found
            else:
                many = middle
        gone = sum(self._take_out(block, ranks[block] > price) for block in blocks)
        run.announce(ShedAtEnd(gone, run.count(), len(views), before, after))

    def announce(self, taken: int) -> None:
        """Tell listeners how far this is."""
        self._run.announce(Shedding(taken, ROUNDS + 1))

    def _views(self) -> list[View]:
        """Those that tell."""
        views, steps = self._whole.views(), self._run.state.step
        wanted = min(max(steps // STEPS_EACH, FEWEST_VIEWS), MOST_VIEWS)
        return views[:: -(-len(views) // wanted)]

    def _rank(self, block: int) -> Float[Tensor, "n"]:
        """Of a block and its mail; of those that wait nobody is drawn."""
        state = with_mail(self._run.scene, block)
        found = rank(state, self._run.state.views.get(block, 0))
        self._seen.append(found[~state.waits])
        return found

    def _psnr(self, views: list[View], price: float) -> float:
        """Mean over views without who ranks no higher than a price, dB."""
        pictures = self._whole.pictures(views, Without(self._run.scene, self._seen, price))
        found = []
        for view, picture in zip(views, pictures.draw(views), strict=True):
            seen, photo, counts = self._whole.beside(view, picture.color)
            square = ((seen.clamp(0, 1) - photo) * counts).square().sum() / (3 * counts.sum()).clamp_min(1.0)
            found.append(-10 * square.clamp_min(LEAST_ERROR).log10())
        return float(torch.stack(found).mean())

    def _take_out(self, block: int, stays: Tensor) -> int:
        """Put a block to rest with its mail, and without the others; how many these are."""
        run, scene = self._run, self._run.scene
        gone = int((~stays).sum())
        if gone:
            left = with_mail(scene, block)[stays]
            run.rest(scene.tree, {block: left, **inbox_without(scene, {block})}, within=0.0)
        return gone
