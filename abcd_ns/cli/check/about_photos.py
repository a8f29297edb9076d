"""What is doubtful about the photos themselves."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from abcd_ns.cli.check.survey import Survey
from abcd_ns.cli.findings import Finding, error, note, warning
from abcd_ns.cli.terminal import few, many
from abcd_ns.data.photos import default_budget
from abcd_ns.data.prepare import DOWNSCALE, MAX_AUTO_SIDE
from abcd_ns.units import bytes_in_words

FEW_PHOTOS = 8
MANY_PIXELS = 4e6
"""Of a photo. Scores of 3DGS are usually given for 1.6 million and less."""
DARK, BRIGHT = 0.02, 0.98
"""Mean luma beyond which a photo shows nothing."""
EXPOSURES = 3.0
"""Largest ratio of mean lumas, the brightest and darkest twentieth left out, that one exposure explains. A
room with windows (bonsai, of Mip-NeRF 360) has 2.3."""


def damaged(survey: Survey) -> Iterator[Finding]:
    """Photos that begin and end as they should, with damage between; training would stop at them."""
    for look in survey.looks:
        if look.error is not None:
            yield error("damaged-photo", look.error)


def few_photos(survey: Survey) -> Iterator[Finding]:
    """Too few photos."""
    count = len(survey.names)
    if count < FEW_PHOTOS:
        yield warning(
            "few-photos",
            f"There are only {count} photos. What few photos show can be explained by many wrong scenes: new "
            "views will look torn.",
            "Take more photos, each sharing most of what it shows with others; some dozen for an object, "
            "hundreds for a building.",
        )


def mixed_sizes(survey: Survey) -> Iterator[Finding]:
    """Photos of several sizes."""
    sizes = Counter(source.size for source in survey.sources)
    if len(sizes) > 1:
        listed = [f"{many(n, 'photo', 'photos')} of {w} x {h}" for (w, h), n in sizes.most_common(3)]
        yield note("mixed-sizes", f"Photos differ in size: {few(listed, len(sizes))}. That is no fault.")


def large_photos(survey: Survey) -> Iterator[Finding]:
    """Photos that will make training slow."""
    width, height = max((source.size for source in survey.sources), key=lambda size: size[0] * size[1])
    if width * height > MANY_PIXELS:
        yield note(
            "large-photos",
            f"Photos of up to {width} x {height} px are trained on, which takes long.",
            f"For a first result leave out {DOWNSCALE}: photos are then reduced to {MAX_AUTO_SIDE} px.",
        )


def memory(survey: Survey) -> Iterator[Finding]:
    """Photos that do not fit into their share of RAM."""
    needed, budget = photo_bytes(survey), default_budget()
    if needed > budget:
        yield note(
            "photos-beyond-ram",
            f"Decoded photos take {bytes_in_words(needed)}, and {bytes_in_words(budget)} of them are kept in "
            "RAM; the others are decoded again whenever they are needed, which takes time.",
            "If there is RAM, give more with --pipeline.datamanager.photo-cache-gb, or reduce the photos.",
        )


def photo_bytes(survey: Survey) -> int:
    """Bytes of all photos and masks, decoded."""
    pixels = (
        source.size[0] * source.size[1] * ((4 if look.alpha else 3) + bool(source.mask_path))
        for source, look in zip(survey.sources, survey.looks, strict=True)
    )
    return sum(pixels)


def duplicates(survey: Survey) -> Iterator[Finding]:
    """Files with the same bytes under several names."""
    if not survey.copies:
        return
    held_out = set(survey.held_out)
    leaks = sum(0 < len(held_out & set(rows)) < len(rows) for rows in survey.copies)
    listed = few([" = ".join(survey.names[row] for row in rows) for rows in survey.copies])
    what = f"{many(len(survey.copies), 'photo is', 'photos are')} there under several names: {listed}."
    if leaks:
        both = many(leaks, "of them is", "of them are")
        what += f" {both} both trained on and held out, so scores are too good."
    yield warning("duplicate-photos", what, "Keep one of each, and make the model again.")


def exposure(survey: Survey) -> Iterator[Finding]:
    """Brightness that differs more than what is shown explains."""
    lumas = np.array([look.brightness for look in survey.looks if look.error is None])
    lumas = lumas[(lumas > DARK) & (lumas < BRIGHT)]
    if len(lumas) < FEW_PHOTOS:
        return
    low, high = np.quantile(lumas, [0.05, 0.95])
    if high > EXPOSURES * low:
        yield warning(
            "exposure",
            f"Photos differ in brightness by a factor of {high / low:.1f}. If that is the camera's exposure "
            "and not what they show, Gaussians before single cameras will imitate it as fog.",
            "Photograph with fixed exposure and white balance, even the photos out, or train with "
            "--pipeline.training.light affine.",
        )


def blank(survey: Survey) -> Iterator[Finding]:
    """Photos that are black or white all over."""
    names = survey.chosen(lambda look: look.error is None and not DARK <= look.brightness <= BRIGHT)
    if names:
        count = many(len(names), "photo is", "photos are")
        yield warning(
            "blank-photos",
            f"{count} black or white nearly all over: {few(names)}.",
            "Look at them, and leave out what shows nothing.",
        )


def orientation(survey: Survey) -> Iterator[Finding]:
    """Photos that viewers turn and training does not."""
    names = survey.chosen(lambda look: look.orientation != 1)
    if names:
        count = many(len(names), "photo has", "photos have")
        yield note(
            "exif-orientation",
            f"{count} an EXIF orientation ({few(names)}). It is not applied, as COLMAP does not: pixels are "
            "used as they are stored.",
            "If another program made the poses and renderings come out turned, save the photos turned and "
            "without EXIF.",
        )


def alpha(survey: Survey) -> Iterator[Finding]:
    """Photos with transparency."""
    names = survey.chosen(lambda look: look.alpha)
    if names:
        count = many(len(names), "photo has", "photos have")
        yield note(
            "alpha",
            f"{count} an alpha channel: photo and rendering are put onto the same background, by default a "
            "new random colour in every step, so that transparent parts become empty.",
        )


def masks(survey: Survey) -> Iterator[Finding]:
    """Photos with masks."""
    masked = sum(source.mask_path is not None for source in survey.sources)
    if masked:
        count = many(masked, "photo has", "photos have")
        yield note("masks", f"{count} a mask: what is black in it is not trained on, the rest is.")


def split(survey: Survey) -> Iterator[Finding]:
    """A split that leaves little on one side."""
    if len(survey.train) < 2:
        yield warning(
            "few-training-views",
            f"Only {len(survey.train)} view is trained on, {len(survey.held_out)} held out.",
            "Hold out fewer: --pipeline.datamanager.dataparser.eval-interval, or eval-mode all.",
        )


ALL = (damaged, few_photos, split, duplicates, blank, exposure, orientation)
ALL += (mixed_sizes, large_photos, memory, alpha, masks)
