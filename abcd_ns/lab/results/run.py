"""What a run found, or why it found nothing."""

from dataclasses import dataclass

from abcd_ns.machine import Versions


@dataclass(frozen=True)
class CurvePoint:
    """Where a run stood at one moment."""

    seconds: float
    """Of training; evaluation does not count."""
    steps: int
    psnr: float
    """Mean over the held-out views, merged, dB."""
    gaussians: int | None = None
    """That were drawn, of the whole scene; None in results of versions that did not count them."""


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
    """Composited, dB. Likewise `ssim` and `lpips`. With `abcd compare --tiles` nothing is held out: of the
    crops trained on, mean of the last visit's steps."""
    ssim: float | None
    lpips: float | None
    lpips_reason: str | None
    """Why `lpips` is None."""
    psnr_merged: float | None
    """All Gaussians drawn at once, as every viewer does, dB. Likewise `ssim_merged`. None where nothing is
    held out."""
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
    """On disk: the stored blocks, with their optimiser state."""
    layer_seconds: float
    """Training time that went into drawing layers."""
    curve: tuple[CurvePoint, ...]
    views: tuple[ViewScore, ...]
    versions: Versions
    """Of the run itself, which may be older than the file it is listed in."""
    peak_reserved_bytes: int | None = None
    """The most that torch took from the GPU for what it held, likewise; None in results of versions that
    did not ask."""
    parameters: int | None = None
    """Of how many numbers the Gaussians are: harmonics count up to the degree that each has. None in results
    of versions that gave all the same degree, and of `abcd compare --tiles`."""
    ply_bytes: int | None = None
    """Of the scene as a .ply; None in results of versions that did not ask, of more than four million
    Gaussians, and of `abcd compare --tiles`."""
    spz_bytes: int | None = None
    """Likewise as an .spz in the run's frame, in which harmonics that are nothing take next to nothing; None
    also where the package is missing that packs it."""
    gaussian_bytes: int | None = None
    """The most that Gaussians in training and all that is held for each of them took, or they and frozen ones
    that were drawn: by counts at each step, and `memory.DeviceNeeds`. Pictures and layers are apart. None in
    results of versions that did not count, and of methods that hold no block for longer than a drawing."""
    memory: "Footing | None" = None
    """What `abcd compare --tiles` asks beyond."""


@dataclass(frozen=True)
class Footing:
    """Where a run's memory and time began, and what a visit took."""

    base_rss_bytes: int
    """RAM before the scene was made: Python, torch and the kernels."""
    make_seconds: float
    plan_seconds: float
    """Until the first visit began: which views see which block."""
    visit_seconds: float | None
    """Mean of the visits but the first, whose time holds `plan_seconds`."""
    layer_seconds: float | None
    """Of it, for layers."""


@dataclass(frozen=True)
class Failure:
    """A run that came to nothing."""

    method: str
    seed: int
    reason: str
    """The last line of its log."""
    log: str
    """Its log, relative to the results' folder."""
    variant: str = "default"
    """What was changed of the method's options."""
