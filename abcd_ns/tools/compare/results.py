"""results.json: everything a comparison found, with what is needed to do it again."""

from dataclasses import dataclass
from pathlib import Path

from abcd_ns.tools.compare.machine import Machine, Versions
from abcd_ns.tools.compare.records import RecordError, decode, encode, read_json, write_json

SCHEMA = 1
"""Raised whenever a field changes its name or meaning."""


@dataclass(frozen=True)
class CurvePoint:
    """Where a run stood at one moment."""

    seconds: float
    """Of training; evaluation does not count."""
    steps: int
    psnr: float
    """Mean over the held-out views, merged, dB."""


@dataclass(frozen=True)
class ViewScore:
    """One held-out view after training."""

    row: int
    """In the list of held-out views."""
    name: str
    """The photo's file name."""
    psnr: float
    ssim: float | None
    """None where the picture is smaller than SSIM's window."""
    lpips: float | None
    psnr_merged: float
    ssim_merged: float | None


@dataclass(frozen=True)
class Run:
    """One method on the scene, once. Scores are means over the held-out views."""

    method: str
    scene: str
    seed: int
    blocks: int
    steps: int
    train_seconds: float
    """Of training, drawing layers included; evaluation, saving and warm-up not."""
    total_seconds: float
    """Of the process, from its start to the end of saving; evaluation not."""
    psnr: float
    """Composited, dB. Likewise `ssim` and `lpips`."""
    ssim: float | None
    lpips: float | None
    lpips_reason: str | None
    """Why `lpips` is None."""
    psnr_merged: float
    """All Gaussians drawn at once, as every viewer does, dB. Likewise `ssim_merged`."""
    ssim_merged: float | None
    ordering_gap_db: float | None
    """PSNR of the merged against the composited pictures, from the mean of the views' squared errors."""
    ordering_gap_note: str | None
    """Why `ordering_gap_db` is None."""
    gaussians: int
    peak_device_bytes: int | None
    """The most that torch held on the GPU until the end of training."""
    peak_device_note: str | None
    """Why `peak_device_bytes` is None."""
    peak_rss_bytes: int
    """The most RAM that the process held until the end of training, the curve's evaluations included."""
    store_bytes: int
    """On disk: the blocks at rest, with their optimiser state."""
    cache_bytes: int
    """On disk: cached layers."""
    layer_seconds: float
    """Training time that went into drawing layers."""
    curve: tuple[CurvePoint, ...]
    views: tuple[ViewScore, ...]
    versions: Versions
    """Of the run itself, which may be older than the file it is listed in."""


@dataclass(frozen=True)
class Protocol:
    """Everything that defines the comparison."""

    scene: str
    downscale: int
    held_out: str
    seconds: float | None
    steps: int | None
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    blocks: int
    evals: int
    max_gaussians: int
    densify: bool
    pictures: int
    date: str
    """When the comparison was finished: ISO 8601, UTC."""
    command: str


@dataclass(frozen=True)
class Failure:
    """A run that came to nothing."""

    method: str
    seed: int
    reason: str
    """The last line of its log."""
    log: str
    """Its log, relative to the results' folder."""


@dataclass(frozen=True)
class LeftOut:
    """A method that was asked for and cannot run here."""

    method: str
    reason: str


@dataclass(frozen=True)
class Results:
    """The whole of results.json."""

    schema: int
    protocol: Protocol
    machine: Machine
    versions: Versions
    runs: tuple[Run, ...]
    failures: tuple[Failure, ...] = ()
    left_out: tuple[LeftOut, ...] = ()

    def of(self, method: str) -> tuple[Run, ...]:
        """The method's runs, one per seed."""
        return tuple(run for run in self.runs if run.method == method)

    @property
    def methods(self) -> tuple[str, ...]:
        """Those with at least one run, in the protocol's order."""
        return tuple(method for method in self.protocol.methods if self.of(method))


def write_results(path: Path, results: Results) -> None:
    """Write results.json.

    Raises:
        ValueError: a number is NaN or infinite.
    """
    write_json(path, encode(results))


def read_results(path: Path) -> Results:
    """Read results.json back.

    Raises:
        RecordError: it is absent, of another schema, or does not fit the schema.
    """
    data = read_json(path)
    schema = data.get("schema") if isinstance(data, dict) else None
    if schema != SCHEMA:
        raise RecordError(f"{path} has schema {schema!r}; this version of abcd reads schema {SCHEMA}.")
    return decode(Results, data, str(path))
