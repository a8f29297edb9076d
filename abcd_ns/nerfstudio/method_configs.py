"""The configurations of the methods that `abcd_ns.methods` registers."""

from nerfstudio.plugins.types import MethodSpecification

from abcd_ns.engine.gaussians.param_swap import LEARNING_RATES
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.nerfstudio.pipeline import AbcdPipelineConfig
from abcd_ns.nerfstudio.trainer import AbcdTrainerConfig, FusedAdamConfig

ALONE = 0.01  # 3DGS's share that the rate of means falls to, where no other rate falls
PAPER = TrainingConfig(
    recipe=Recipe(
        ownership="means",
        visit_steps=5000,
        keep_moments=False,
        sh_restart=True,
        migrate=False,
        pixel_loss="l2",
        fast_start=False,
        dropout=0.0,
        visit_views=10**6,
        limit_scales=False,
        means_lr_decay=ALONE,
    ),
    warmup=0.0,
    batch=1,
    ssim_lambda=0.0,
    point_pixels=0.0,
    coarse=0.0,
    density=DensityConfig(min_contribution=0.0),
)
"""What Shiu and Subr 2026 did, as far as it is published; docs/reference.md says where it is not."""
PEER_BLOCKS = 8


def _method(name: str, description: str, **pipeline) -> MethodSpecification:
    config = AbcdTrainerConfig(
        method_name=name,
        steps_per_eval_image=500,
        steps_per_eval_batch=0,
        steps_per_eval_all_images=2000,
        mixed_precision=False,
        pipeline=AbcdPipelineConfig(**pipeline),
        optimizers={
            name: {"optimizer": FusedAdamConfig(lr=rate, eps=1e-15), "scheduler": None}
            for name, rate in LEARNING_RATES.items()
        },
        vis="viewer",
    )
    # ABCD reports its own progress, by visit; nerfstudio's table would run through it.
    config.logging.local_writer.enable = False
    return MethodSpecification(config, description)


abcd = _method("abcd", "ABCD: Gaussian Splatting block by block, each within alpha-composited frozen layers.")
abcd_ablated = _method(
    "abcd-ablated",
    "ABCD without its layers: each block alone against the photos (the paper's ablation).",
    blocks=PEER_BLOCKS,
    training=TrainingConfig(recipe=Recipe(layers=False)),
)
abcd_partition = _method(
    "abcd-partition",
    "Partition, train, merge: overlapping blocks, each trained once and by itself.",
    blocks=PEER_BLOCKS,
    training=TrainingConfig(
        recipe=Recipe(layers=False, overlap=0.2, migrate=False, means_lr_decay=ALONE),
        warmup=0.0,
        density=DensityConfig(min_contribution=0.0),  # blocks have one visit, and nothing after it
    ),
)
abcd_exact = _method(
    "abcd-exact",
    "Exact joint training over blocks, one on the device at a time: slow, the reference.",
    blocks=PEER_BLOCKS,
    training=TrainingConfig(recipe=Recipe(exact=True, means_lr_decay=ALONE), warmup=0.0),
)
abcd_paper = _method(
    "abcd-paper",
    "ABCD by its paper's recipe: MSE, fixed steps for each cell, a new Adam at each visit.",
    blocks=PEER_BLOCKS,
    partition="grid",
    training=PAPER,
)
abcd_monolithic = _method(
    "abcd-monolithic",
    "3D Gaussian Splatting in ABCD's engine: one block, no layers. Runs without a GPU.",
    blocks=1,
)
