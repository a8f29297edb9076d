"""results.json: everything that an experiment found, with what is needed to do it again."""

import re
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from abcd_ns.lab.job import Settings
from abcd_ns.machine import Machine, Versions
from abcd_ns.units import bytes_in_words

SCHEMA = 2  # raised whenever a field changes its name or meaning
RESULTS_FILE = "results.json"
BUDGET = "gaussian_bytes"  # the option that sets a memory budget
TERRAIN = "comparison of sizes"  # the kind of results of `abcd compare --tiles`, where nothing is held out


@dataclass(frozen=True)
class CurvePoint:
    """Where a run stood at one moment."""

    seconds: float  # of training; evaluation does not count
    steps: int
    psnr: float  # mean over the held-out views, merged, dB
    gaussians: int | None = None
    """That were drawn, of the whole scene; None in results of versions that did not count them."""


@dataclass(frozen=True)
class ViewScore:
    """One held-out view after training."""

    row: int  # in the list of held-out views
    name: str  # the photo's file name
    psnr: float
    ssim: float | None  # None in files of older versions, where the picture is smaller than SSIM's window
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
    train_seconds: float  # of training, drawing layers included; evaluation, saving and warm-up not
    total_seconds: float  # of the process, from its start to the end of saving; evaluation not
    psnr: float
    """Composited, dB. Likewise `ssim` and `lpips`. With `abcd compare --tiles` nothing is held out: of the
    crops trained on, mean of the last visit's steps."""
    ssim: float | None
    lpips: float | None
    lpips_reason: str | None  # why `lpips` is None
    psnr_merged: float | None
    """All Gaussians drawn at once, as every viewer does, dB. Likewise `ssim_merged`. None where nothing is
    held out."""
    ssim_merged: float | None
    ordering_gap_db: float | None
    """PSNR of the merged against the composited pictures, from the mean of the views' squared errors."""
    ordering_gap_note: str | None  # why `ordering_gap_db` is None
    gaussians: int
    peak_device_bytes: int | None  # the most that torch held on the GPU until the end of training
    peak_device_note: str | None  # why `peak_device_bytes` is None
    peak_rss_bytes: int
    """The most RAM that the process held until the end of training, the curve's evaluations included."""
    store_bytes: int  # on disk: the stored blocks, with their optimiser state
    layer_seconds: float  # training time that went into drawing layers
    curve: tuple[CurvePoint, ...]
    views: tuple[ViewScore, ...]
    versions: Versions  # of the run itself, which may be older than the file it is listed in
    peak_reserved_bytes: int | None = None
    """The most that torch took from the GPU for what it held, likewise; None in results of versions that
    did not ask."""
    parameters: int | None = None
    """Of how many numbers the Gaussians are: harmonics count up to the degree that each has. None in results
    of versions that gave all the same degree, and of `abcd compare --tiles`."""
    ply_bytes: int | None = None
    """Of the scene as a .ply, which leaves out Gaussians too transparent to be drawn. None in results of
    versions that did not ask, of more than four million Gaussians, and of `abcd compare --tiles`."""
    spz_bytes: int | None = None
    """Likewise as an .spz in the run's frame, in which harmonics that are nothing take next to nothing; None
    also where the package is missing that packs it."""
    gaussian_bytes: int | None = None
    """The most that Gaussians in training and all that is held for each of them took, or they and frozen ones
    that were drawn: by counts at each step, and `memory.DeviceNeeds`. Pictures and layers are apart. None in
    results of versions that did not count, and of methods that hold no block for longer than a drawing."""
    memory: "Footing | None" = None  # what `abcd compare --tiles` asks beyond


@dataclass(frozen=True)
class Footing:
    """Where a run's memory and time began, and what a visit took."""

    base_rss_bytes: int  # RAM before the scene was made: Python, torch and the kernels
    make_seconds: float
    plan_seconds: float  # until the first visit began: which views see which block
    visit_seconds: float | None  # mean of the visits but the first, whose time holds `plan_seconds`
    layer_seconds: float | None  # of it, for layers


@dataclass(frozen=True)
class Failure:
    """A run that came to nothing."""

    method: str
    seed: int
    reason: str  # the last line of its log
    log: str  # its log, relative to the results' folder
    variant: str = "default"  # what was changed of the method's options


@dataclass(frozen=True)
class Arm:
    """One method with one thing set, and its runs."""

    method: str
    variant: str  # what is set: `blocks=4`, or "default"
    value: int | None  # what it is set to, where that is a whole number
    runs: tuple[Run, ...]  # one for each seed that did not fail

    @property
    def name(self) -> str:
        """The method, and what of it is set."""
        return self.method if self.variant == "default" else f"{self.method} {self.variant}"

    @property
    def is_budgeted(self) -> bool:
        """Whether its runs keep to a memory budget."""
        return self.variant.startswith(BUDGET)

    def mean(self, field: str) -> float:
        """Over the seeds, of a field of `Run` that all of them know."""
        return fmean(getattr(run, field) for run in self.runs)


@dataclass(frozen=True)
class LeftOut:
    """A method that was asked for and cannot run here."""

    method: str
    reason: str


@dataclass(frozen=True)
class Outcome:
    """One way in which methods fail, and what came of it here."""

    id: str
    fails: str  # what happens elsewhere
    done: str  # what is done here to make it happen
    rule: str  # what passes
    passed: bool
    worse: bool  # whether ABCD did worse than one block, whatever the rule says
    said: dict[str, str]  # by method, what it did, in a few words
    numbers: dict[str, float]  # what the rule was applied to, by name
    seconds: float


@dataclass(frozen=True)
class Results:
    """The whole of results.json."""

    schema: int
    kind: str  # of the experiment: "comparison", "stability report"; older ones have "study of ..." too
    date: str  # ISO 8601, UTC
    command: str  # the command line that makes the same, without where its folders are
    machine: Machine
    versions: Versions
    settings: Settings | None = None
    """What all runs share, `data` being the name of the scene alone; None where nothing is held out."""
    seeds: tuple[int, ...] = ()
    arms: tuple[Arm, ...] = ()  # those with a run
    outcomes: tuple[Outcome, ...] = ()
    curves: tuple[dict[str, Any], ...] = ()
    """Of older stability reports: held-out PSNR against one thing each."""
    failures: tuple[Failure, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    findings: tuple[str, ...] = ()  # what the experiment says, a sentence each
    notes: tuple[str, ...] = ()  # what a reader of the table has to know

    @property
    def means_of(self) -> str:
        """What an arm's numbers are means of, in words; empty where each has but one run."""
        runs = sorted(len(arm.runs) for arm in self.arms) or [1]
        few = "" if runs[0] == runs[-1] else f"{runs[0]} to "
        return f"mean of {few}{runs[-1]} seeds" if runs[-1] > 1 else ""

    @property
    def title(self) -> str:
        """Scene, size, blocks, budget and seeds, as charts have them; empty where nothing is held out."""
        if (s := self.settings) is None:
            return ""
        blocks = [f"{s.blocks} block{'s' * (s.blocks > 1)}"] if s.blocks else []
        means = [self.means_of] if self.means_of else []
        return ", ".join([s.scene, f"1/{s.downscale} size", *blocks, s.budget, *means])

    def of(self, method: str) -> tuple[Arm, ...]:
        """The method's arms, in their order."""
        return tuple(arm for arm in self.arms if arm.method == method)

    @property
    def labels(self) -> dict[str, str]:
        """By name of an arm, what a chart calls it: `abcd, 8 blocks, warmup=0`; of one method `8 blocks`."""
        found = {}
        for arm in self.arms:
            words = [re.sub(r"^[\w.]+\.(\w+=)", r"\1", word) for word in arm.variant.split()]
            words = [re.sub(r"^(block|tile)s=(\d+)$", r"\2 \1s", word) for word in words]
            words = [re.sub(r"^1 (\w+)s$", r"1 \1", word) for word in words if word != "default"]
            words = [re.sub(r"^gaussian_bytes=(\d+)$", lambda m: bytes_in_words(int(m[1])), w) for w in words]
            found[arm.name] = ", ".join([arm.method] * (len(self.methods) > 1) + words) or arm.method
        return found

    def baseline(self, arm: Arm) -> Arm | None:
        """The arm of the same method and number of blocks without the changes, if there is any."""
        arms = {other.variant: other for other in self.of(arm.method) if other is not arm}
        blocks = " ".join(word for word in arm.variant.split() if word.startswith("blocks="))
        return arms.get(blocks, arms.get("default"))

    @property
    def methods(self) -> tuple[str, ...]:
        """Those with a run."""
        return tuple(dict.fromkeys(arm.method for arm in self.arms))

    @property
    def runs(self) -> tuple[Run, ...]:
        return tuple(run for arm in self.arms for run in arm.runs)
