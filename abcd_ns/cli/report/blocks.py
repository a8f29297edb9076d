"""The blocks of a run: how large they are, how often they were trained, and how well."""

from dataclasses import dataclass

from abcd_ns.cli.report.run_folder import RunFolder
from abcd_ns.cli.report.story import Story
from abcd_ns.engine.train.run_state import RunState


@dataclass(frozen=True)
class Block:
    """One row of the table of blocks."""

    number: int
    """From 1, as the progress line counts."""
    gaussians: int | None
    """None where no checkpoint has the block."""
    parameters: int | None
    """Of how many numbers they are; None where it is not known."""
    shed: int | None
    """Gaussians taken out that filled too little of their views; None where it is not known."""
    filled: float | None
    """Pixels that a Gaussian fills in all its views, the median; None where nobody was weighed."""
    views: int | None
    """That it is trained on; None where it is not known."""
    visits: int
    """That have ended."""
    seconds: float
    """Spent on its visits."""
    layer_seconds: float
    psnrs: tuple[float, ...]
    """Of its visits, on training crops, dB."""
    state: str


def describe_blocks(run: RunFolder) -> list[Block]:
    """All blocks, by number."""
    counts = []
    if run.checkpoint is not None:
        tree = run.checkpoint.tree
        counts = tree.assign(run.checkpoint.means).bincount(minlength=tree.num_blocks).tolist()
    counts += [None] * (run.story.blocks - len(counts))  # cut off since the checkpoint, or there is none
    return [_describe(run, block, count) for block, count in enumerate(counts)]


def _describe(run: RunFolder, block: int, gaussians: int | None) -> Block:
    visits, health = run.story.of_block(block), run.state.health
    return Block(
        number=block + 1,
        gaussians=gaussians,
        parameters=run.parameters.get(block),
        shed=None if block not in health else health[block].shed,
        filled=run.filled.get(block),
        views=run.state.views.get(block),
        visits=sum(visit.done for visit in visits),
        seconds=sum(visit.seconds for visit in visits),
        layer_seconds=sum(visit.layer_seconds for visit in visits),
        psnrs=tuple(visit.psnr for visit in visits if visit.psnr is not None),
        state=_state(run.story, run.state, block, gaussians),
    )


def _state(story: Story, state: RunState, block: int, gaussians: int | None) -> str:
    if not story.visits:
        return "trained in every step"
    if state.active is not None and state.active.geometry.block == block:
        return "in training when saved"
    if gaussians == 0:
        return "empty"
    if any(visit.done for visit in story.of_block(block)):
        return "trained"
    if state.views.get(block) == 0:
        return "no view shows it"
    return "in the warm-up only" if any(visit.block is None for visit in story.visits) else "not yet visited"
