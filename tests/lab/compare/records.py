"""Made-up runs for tests of what experiments write. No number here was ever measured."""

import dataclasses
from pathlib import Path

from abcd_ns.lab.job import Settings
from abcd_ns.lab.results.records import read_record
from abcd_ns.lab.results.results import SCHEMA, Arm, CurvePoint, Failure, LeftOut, Results, Run, ViewScore
from abcd_ns.lab.results.tables import findings_of
from abcd_ns.machine import Machine, Versions

MACHINE = Machine(cpu="Made-up CPU", cores=2, torch_threads=2, ram_bytes=8 << 30, gpu=None, os="Linux x86_64")
VERSIONS = Versions(python="3.11", torch="2.11", nerfstudio="1.1.5", gsplat="1.4.0", abcd_ns="0", commit=None)


def read_results(path: Path) -> Results:
    return read_record(path, Results, SCHEMA)


def made_up_run(method: str = "abcd", seed: int = 0, psnr: float = 24.0, **fields) -> Run:
    """A run that rises towards `psnr`."""
    moments = [(k / 6) ** 2 * 60 for k in range(1, 7)]
    curve = [CurvePoint(s, int(s * 10), psnr - 9 / (1 + s)) for s in moments]
    made = {"method": method, "scene": "made-up", "seed": seed, "steps": 600, "versions": VERSIONS}
    size = {"blocks": 1 if method == "abcd-monolithic" else 8, "gaussians": 12345, "store_bytes": 1 << 28}
    times = {"train_seconds": 60.0, "total_seconds": 75.5, "layer_seconds": 12.0, "curve": tuple(curve)}
    scores = {"psnr": psnr - 0.1, "ssim": 0.8, "psnr_merged": curve[-1].psnr, "ssim_merged": 0.79}
    scores["views"] = (ViewScore(0, "0000.png", psnr, 0.8, None, psnr, None),)
    lpips = {"lpips": None, "lpips_reason": "no weights"}
    gap = {"ordering_gap_db": 45.0, "ordering_gap_note": None}
    peaks = {"peak_rss_bytes": 3 << 29, "peak_device_bytes": None, "peak_device_note": "no CUDA device"}
    return Run(**{**made, **size, **times, **scores, **lpips, **gap, **peaks, **fields})


def made_up_settings(**fields) -> Settings:
    values = {"data": "made-up", "downscale": 4, "blocks": 8, "seconds": 60.0, "steps": None, "evals": 6}
    return Settings(**{**values, "pictures": 3, **fields})


def made_up(kind: str, *arms: Arm, **fields) -> Results:
    values = {"settings": made_up_settings(), "seeds": (0,), "arms": arms, **fields}
    results = Results(SCHEMA, kind, "2026-01-01T00:00:00+00:00", "abcd", MACHINE, VERSIONS, **values)
    return dataclasses.replace(results, findings=findings_of(results))


def made_up_arm(variant: str, psnrs: dict[int, float], method="abcd", **fields) -> Arm:
    runs = (made_up_run(method, seed, psnr_merged=psnr, psnr=psnr, **fields) for seed, psnr in psnrs.items())
    return Arm(method, variant, None, tuple(runs))


def made_up_results(*runs: Run, **fields) -> Results:
    methods = dict.fromkeys(run.method for run in runs)
    arms = [Arm(m, "default", None, tuple(run for run in runs if run.method == m)) for m in methods]
    failure = Failure("abcd-ablated", 0, "it broke", "runs/abcd-ablated/seed-0/log.txt")
    left = LeftOut("splatfacto", "it needs a CUDA device")
    return made_up("comparison", *arms, **{"failures": (failure,), "left_out": (left,), **fields})
