"""When poses are refined, and how: by pictures of the whole scene, in the warm-up and between visits."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import PhotosWanted
from abcd_ns.engine.render import Raster
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.engine.train.capture.poses import by_step, robust, step_for
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.train.step.layer_source import WholeViews
from abcd_ns.engine.types import View

FIRST = 16.0
"""Uses of each view by the whole scene before its pose is refined: from blobs, poses only become worse."""
LATEST = 0.3
"""Share of the run after which it is, whatever the uses: workers leave poses as the warm-up found them."""
EVERY, SHARE = 1.0, 0.04
"""Uses of each view from round to round, at least, and as a share of all so far."""


class PoseRounds:
    """Refines all poses of a run once in a while, each by a picture of the whole scene beside its `target`.
    Never while a visit among others is under way, for its layers are drawn from the poses as they were."""

    def __init__(self, run: TrainingRun, target: Callable[[Sample], Target]) -> None:
        self._run, self._whole = run, WholeViews(run, target)

    def count(self, pictures: int) -> None:
        """A step of the visit that is under way has drawn so many pictures, of its block or of the scene."""
        run = self._run
        blocks = 1 if run.active.is_alone else run.scene.tree.num_blocks
        run.state.uses += pictures / len(run.views) / blocks

    @property
    def is_due(self) -> bool:
        state = self._run.state
        if state.active is not None and not state.active.is_alone:
            return False
        if state.uses < FIRST and self._run.progress < LATEST:
            return False
        return state.uses - state.posed >= max(EVERY, SHARE * state.uses)

    def take(self) -> None:
        run, views = self._run, self._whole.views()
        steps: dict[int, Tensor] = {}
        scene = run.scene
        if scene.is_active_as_a_whole:  # parted once, not for each block of each group
            scene = MemoryScene(scene.tree, scene.everything(run.device))
        pictures = self._whole.pictures(views, scene)
        judged: dict[int, tuple[Raster, Float[Tensor, "h w 3"]]] = {}

        def gradient(view: View, picture: Raster) -> Float[Tensor, "h w 3"]:
            shown = picture.color.detach().requires_grad_()
            seen, photo, counts = self._whole.beside(view, shown)
            loss, weight = robust((seen - photo) * counts)
            judged[view.index] = picture, weight * counts
            (by_picture,) = torch.autograd.grad(loss, shown)
            return by_picture

        for group in pictures.groups(views):
            run.announce(PhotosWanted(tuple(view.index for view in group)))
            judged.clear()
            found = pictures.differentiate(group, gradient)
            for view, by_matrix in zip(group, found, strict=True):
                picture, weight = judged[view.index]
                steps[view.index] = step_for(view, picture, weight, by_step(by_matrix, view.viewmat))
        run.poses.move(steps)
        run.state.posed = run.state.uses
