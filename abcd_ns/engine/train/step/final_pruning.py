"""Final pruning: when a run is complete, remove what its pictures hardly miss.

RadSplat (Niemeyer et al., 2024), LightGaussian (Fan et al., NeurIPS 2024) and Speedy-Splat (Hanson et al.,
CVPR 2025) leave out a given share of what ranks lowest. Here the pictures say how many: as many as training
views can spare.

A pixel is linear in each Gaussian's opacity o, so that without the Gaussian it changes by o dC/do. One
drawing backward tells the sum of its squares over pixels for all Gaussians at once (Hutchinson 1990): with
random signs as the gradient of the picture, the square of what comes back is that sum in expectation. As a
share of the view's squared error it is the Gaussian's worth in dB, if it alone went.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import PhotosWanted, PrunedAtEnd, Pruning
from abcd_ns.engine.render import Raster
from abcd_ns.engine.store.commit import pending_without, with_pending
from abcd_ns.engine.store.scene import BlockScene, ChangedScene, HeldScene
from abcd_ns.engine.train.memory import free_bytes, needs_of
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.schedule import evenly
from abcd_ns.engine.train.step.batch import Sample, Target, background
from abcd_ns.engine.train.step.layer_source import WholeViews
from abcd_ns.engine.transfer import upload
from abcd_ns.engine.types import Gaussians, View

LOSS = 0.05
"""Of the mean PSNR of training views, dB, that it may cost."""
MOST_PRUNED = 0.75
"""Of all Gaussians, at most. Where no picture is better than what was trained, that would be all."""
RANKING = 16
"""Views that a block was trained on, for each that Gaussians are ranked by: of a short run not all are."""
MOST_RANKED = 256
"""Of these at most: for each, all that it shows is read and drawn twice."""
FEWEST, MOST, STEPS_EACH = 5, 32, 100
"""Views that tell how much may go: at least, at most, and steps of a short run for each."""
ROUNDS = 6
"""Of trying how many may go: as many as should cost LOSS, then twice that, or what halves the doubt."""
PER_NEPER = 10 / math.log(10)
"""dB that the logarithm of a squared error is worth."""
OPAQUE = math.log(0.99 / 0.01)
"""Logit up to which opacities are drawn: where alpha is at its limit, 0.999, no gradient tells of them."""
LEAST_ERROR = 1e-10
"""Mean squared difference below which a picture is its photo."""


class _Probe:
    """Opacities of a scene as leaves, and what their gradients say that Gaussians are worth."""

    def __init__(self) -> None:
        self._leaves: dict[int, Tensor] = {}
        self._worth: dict[int, Tensor] = {}

    def with_leaf(self, block: int, gaussians: Gaussians) -> Gaussians:
        """A block as it is to be drawn."""
        if block not in self._leaves:
            self._leaves[block] = gaussians.opacities.detach().clone().clamp_(max=OPAQUE).requires_grad_()
        return replace(gaussians, opacities=self._leaves[block])

    def accumulate(self) -> None:
        """A view has been drawn backward, or what a node shows in it: a pixel has each Gaussian in one."""
        for block, logits in self._leaves.items():
            if logits.grad is not None:
                # By o dC/do = dC/dlogit / (1 - o).
                change = logits.grad / torch.sigmoid(-logits.detach()).clamp_min(1e-6)
                self._worth[block] = self._worth.get(block, 0.0) + change.flatten().square()
                logits.grad = None

    def worth(self, block: int, scene: BlockScene) -> Float[Tensor, "n"]:
        """Of those that are drawn of the scene's block; 0 for what showed in no view."""
        found = self._worth.get(block)
        return torch.zeros(len(scene.gaussians(block))) if found is None else found.cpu()


class FinalPruning:
    """Takes as many Gaussians as cost LOSS at most out of a run's stored scene; `target` gives the photos."""

    def __init__(self, run: TrainingRun, target: Callable[[Sample], Target]) -> None:
        self._run, self._whole = run, WholeViews(run, target)

    def run(self) -> None:
        """Rank, find out how many may go, and take them out; listeners hear how many, and at what cost."""
        run = self._run
        views, step = self._whole.views(), run.state.step
        scene = HeldScene(run.scene, run.device, self._room(views))
        worth = self._worth(scene, views)
        ranked = torch.cat(worth)
        ranked = ranked[ranked.isfinite()].sort().values
        costs = ranked.double().cumsum(0)
        views = evenly(views, min(max(step // STEPS_EACH, FEWEST), MOST))
        before = after = self._psnr(scene, views, worth, -1.0, 0)
        most = max(int(MOST_PRUNED * len(ranked)), 1)
        few, many, least, guess = 0, most + 1, -1.0, LOSS
        for taken in range(ROUNDS):
            suggested = min(int(torch.searchsorted(costs, guess)), most)
            number = suggested if many > most else (few + many) // 2
            if number <= few:
                break
            tried = float(ranked[number - 1])
            found = self._psnr(scene, views, worth, tried, taken + 1)
            if before - found <= LOSS:
                few, least, after, guess = number, tried, found, 2 * guess
            else:
                many = number
        del scene
        gone = sum(self._prune_block(block, of_block, least) for block, of_block in enumerate(worth))
        run.announce(PrunedAtEnd(gone, run.count(), len(views), before, after))

    def _room(self, views: Sequence[View]) -> int:
        """For blocks that are held on the device, bytes: a third of what an active one takes."""
        run, limit = self._run, self._run.config.limits.block_limit
        if run.device.type == "cpu":  # their RAM has a budget of its own
            return 0
        needs = needs_of(run.config, max(view.full.pixels for view in views), run.blocks)
        free = free_bytes(run.device)
        return min(free, limit * needs.gaussian_bytes if limit else free) // 3

    def _worth(self, scene: BlockScene, views: list[View]) -> list[Float[Tensor, "_n"]]:
        """By block, what drawn Gaussians are worth, dB of the mean PSNR; infinite for what shows in none of
        the ranked views, unless they are all."""
        run = self._run
        blocks = range(run.scene.tree.num_blocks)
        trained = sum(run.scene.clocks(block).steps for block in blocks) // len(blocks)
        chosen = evenly(views, min(max(trained // RANKING, FEWEST), MOST_RANKED))
        probe = _Probe()
        pictures = self._whole.pictures(chosen, ChangedScene(scene, probe.with_leaf))
        generator = torch.Generator().manual_seed(run.config.seed)

        def gradient(view: View, picture: Raster) -> Float[Tensor, "h w 3"]:
            square, counts = self._square(view, picture)
            signs = torch.randint(0, 2, picture.color.shape, generator=generator, dtype=torch.int8) * 2 - 1
            signs = upload(signs, run.device).to(picture.color)
            return signs * counts / square.clamp_min(LEAST_ERROR * picture.color.numel()).sqrt()

        for group in pictures.groups(chosen):
            run.announce(Pruning(0, ROUNDS + 1))
            run.announce(PhotosWanted(tuple(view.index for view in group)))
            pictures.backward(group, gradient, probe.accumulate)
        nowhere = 0.0 if len(chosen) == len(views) else torch.inf
        worth = [PER_NEPER / len(chosen) * probe.worth(block, scene) for block in blocks]
        return [torch.where(of_block > 0, of_block, nowhere) for of_block in worth]

    @torch.no_grad()
    def _psnr(
        self, scene: BlockScene, views: list[View], worth: Sequence[Tensor], least: float, rounds: int
    ) -> float:
        """Mean over views without what is worth no more than `least`, dB, after so many rounds."""
        run, found = self._run, []
        left = ChangedScene(scene, lambda block, drawn: drawn[(worth[block] > least).to(run.device)])
        pictures = self._whole.pictures(views, left)
        run.announce(PhotosWanted(tuple(view.index for view in views)))
        for view, picture in zip(views, pictures.draw(views), strict=True):
            run.announce(Pruning(rounds, ROUNDS + 1))
            square, counts = self._square(view, picture)
            error = square / (3 * counts.sum()).clamp_min(1.0)
            found.append(-10 * error.clamp_min(LEAST_ERROR).log10())
        return float(torch.stack(found).mean())

    def _square(self, view: View, picture: Raster) -> tuple[Float[Tensor, ""], Float[Tensor, "h w 1"]]:
        """The squared error of a picture, summed over the pixels that count, and which these are."""
        # With training's background: on black alone, black things would not be missed.
        behind = background(self._run.config, view.index, 0).to(picture.color)
        shown = picture.color.detach() + picture.transmittance.detach()[..., None] * behind
        seen, photo, counts = self._whole.beside(view, shown, behind)
        return ((seen.clamp(0, 1) - photo) * counts).square().sum(), counts

    def _prune_block(self, block: int, worth: Float[Tensor, "n"], least: float) -> int:
        """Persist a block with its migrants, without those worth at most `least`; return how many."""
        run, scene = self._run, self._run.scene
        gone = int((worth <= least).sum())
        if gone:
            state = with_pending(scene, block)
            stays = state.deferred.clone()  # what is not drawn
            stays[~state.deferred] = worth > least
            run.persist(scene.tree, {block: state[stays], **pending_without(scene, block)}, within=0.0)
        return gone
