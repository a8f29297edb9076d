"""Made-up runs for tests of what `abcd compare` writes. No number here was ever measured."""

from abcd_ns.lab.compare.results import SCHEMA, LeftOut, Protocol, Results
from abcd_ns.lab.runs.job import METHODS
from abcd_ns.lab.runs.run import CurvePoint, Failure, Run, ViewScore
from abcd_ns.nerfstudio.machine import Machine, Versions

MACHINE = Machine(cpu="Made-up CPU", cores=2, torch_threads=2, ram_bytes=8 << 30, gpu=None, os="Linux x86_64")
VERSIONS = Versions(python="3.11", torch="2.11", nerfstudio="1.1.5", gsplat="1.4.0", abcd_ns="0", commit=None)


def made_up_run(method: str = "abcd", seed: int = 0, psnr: float = 24.0, speed: float = 1.0, **fields) -> Run:
    """A run that rises towards `psnr`, the faster the larger `speed`."""
    moments = [(k / 6) ** 2 * 60 for k in range(1, 7)]
    curve = [CurvePoint(s, int(s * 10), psnr - 9 / (1 + s * speed)) for s in moments]
    values = {
        "method": method,
        "scene": "made-up",
        "seed": seed,
        "blocks": 1 if method == "abcd-monolithic" else 8,
        "steps": 600,
        "train_seconds": 60.0,
        "total_seconds": 75.5,
        "psnr": psnr - 0.1,
        "ssim": 0.8,
        "lpips": None,
        "lpips_reason": "no weights",
        "psnr_merged": curve[-1].psnr,
        "ssim_merged": 0.79,
        "ordering_gap_db": 45.0,
        "ordering_gap_note": None,
        "gaussians": 12345,
        "peak_device_bytes": None,
        "peak_device_note": "no CUDA device",
        "peak_rss_bytes": 3 << 29,
        "store_bytes": 1 << 28,
        "layer_seconds": 12.0,
        "curve": tuple(curve),
        "views": (ViewScore(0, "0000.png", psnr, 0.8, None, psnr, None),),
        "versions": VERSIONS,
    }
    return Run(**{**values, **fields})


def made_up_results(*runs: Run, seeds: tuple[int, ...] = (0,), **fields) -> Results:
    """Results with these runs."""
    protocol = Protocol(
        scene="made-up",
        downscale=4,
        held_out="every 8th view",
        seconds=60.0,
        steps=None,
        methods=METHODS,
        seeds=seeds,
        blocks=8,
        evals=6,
        max_gaussians=0,
        densify=True,
        pictures=3,
        date="2026-01-01T00:00:00+00:00",
        command="abcd compare",
    )
    values = {
        "schema": SCHEMA,
        "protocol": protocol,
        "machine": MACHINE,
        "versions": VERSIONS,
        "runs": runs,
        "failures": (Failure("abcd-ablated", 0, "it broke", "runs/abcd-ablated/seed-0/log.txt"),),
        "left_out": (LeftOut("splatfacto", "it needs a CUDA device"),),
    }
    return Results(**{**values, **fields})
