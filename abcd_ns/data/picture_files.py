"""Looks at picture files without decoding them: size, kind, and whether the end is there."""

import os
import stat
import warnings
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image, UnidentifiedImageError

from abcd_ns.data.input_errors import InputError

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff"})
"""What counts as a photo when a folder is listed."""

UNREAD = frozenset({".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2"})
"""Pictures that cameras and phones write, and nothing here reads."""

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
"""What is read, by content and not by name. Pillow knows more, some of which it gives to other programs."""
_MODES = frozenset({"RGB", "RGBA", "L", "LA", "P", "1"})
_ENDS = {"JPEG": b"\xff\xd9", "MPO": b"\xff\xd9", "PNG": b"IEND\xaeB`\x82"}
_PNG_BIT_DEPTH_BYTE = 24


@dataclass(frozen=True)
class Header:
    """What a picture file says of itself."""

    size: tuple[int, int]
    """(width, height) as stored: EXIF orientation is not applied, as COLMAP does not."""
    format: str


def check_regular(path: Path, kind: str = "photo") -> None:
    """Refuse what must not be opened: a missing file, a folder, a pipe (it would block), no bytes.

    Args:
        kind: what it is, for the message.

    Raises:
        InputError: names `path`.
    """
    try:
        status = path.stat()
    except OSError as error:
        what = "is a link to nothing" if path.is_symlink() else f"cannot be read ({error.strerror})"
        other = _other_ending(path)
        fix = f"copy the {kind} there" if other is None else f"{other.name} is there: rename it"
        raise InputError(f"{path} {what}; {fix}.") from None
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is not a regular file; copy the {kind} there.")
    if status.st_size == 0:
        raise InputError(f"{path} is empty; copy the {kind} again.")


def _other_ending(path: Path) -> Path | None:
    """A photo of the same name with another ending, as .JPG for .jpg, if there is one."""
    endings = (ending for suffix in sorted(SUFFIXES) for ending in (suffix, suffix.upper()))
    found = (path.with_suffix(ending) for ending in endings if ending != path.suffix)
    return next((other for other in found if os.path.lexists(other)), None) if path.stem else None


def open_picture(path: Path) -> Image.Image:
    """Pillow's picture, not yet decoded, of a format among FORMATS.

    Raises:
        OSError, SyntaxError, ValueError: as Pillow; UnidentifiedImageError is among them.
    """
    return Image.open(path, formats=FORMATS)


def has_alpha(picture: Image.Image) -> bool:
    """Whether some of its pixels may be transparent."""
    return "A" in picture.getbands() or "transparency" in picture.info


def orientation(picture: Image.Image) -> int:
    """EXIF orientation, 1 to 8; 1 is upright."""
    return picture.getexif().get(ExifTags.Base.Orientation, 1)


def undecodable(path: Path, error: Exception) -> InputError:
    """What to say of a file whose header is sound and whose pixels are not."""
    return InputError(f"{path} cannot be decoded ({error}); copy the photo again.")


def read_header(path: Path, check_kind: bool = True) -> Header:
    """The header of a photo or mask; reads a few hundred bytes. Not thread-safe (it sets warning filters).

    Args:
        check_kind: refuse what is not converted to 8-bit RGB without loss; of masks it does not matter.

    Raises:
        InputError: missing, empty, a pipe, no picture of FORMATS, over 89 Mpx; or 16 bits deep or CMYK.
    """
    check_regular(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with open_picture(path) as picture:
                if check_kind:
                    _check_kind(path, picture)
                return Header(picture.size, picture.format or "")
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        fix = "reduce the photo and make the model again" if check_kind else "reduce the mask"
        raise InputError(f"{path} has more than 89 Mpx; {fix}.") from None
    except UnidentifiedImageError:
        raise InputError(f"{path} is not a picture of a known kind; save it as JPEG or PNG.") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); copy the photo again.") from None


def is_turned(path: Path) -> bool:
    """Whether the EXIF orientation of a readable picture swaps width and height."""
    with open_picture(path) as picture:
        return orientation(picture) in (5, 6, 7, 8)


def _check_kind(path: Path, picture: Image.Image) -> None:
    """Refuse pictures whose conversion to 8-bit sRGB would be a guess."""
    deep = picture.mode.startswith(("I", "F"))
    if picture.format == "PNG":
        # Pillow cuts 16-bit RGB to 8 bits without a word, here and in TIFF, so look at the file.
        with path.open("rb") as file:
            deep = deep or file.read(_PNG_BIT_DEPTH_BYTE + 1)[_PNG_BIT_DEPTH_BYTE] == 16
    if picture.format == "TIFF":
        deep = deep or max(picture.tag_v2.get(ExifTags.Base.BitsPerSample, (8,))) > 8
    if deep:
        raise InputError(f"{path} has more than 8 bits a channel; convert it to 8 bits.")
    if picture.mode not in _MODES:
        raise InputError(f"{path} is a {picture.mode} picture; convert it to RGB.")


def check_complete(path: Path, header: Header) -> None:
    """Refuse a cut file, in one short read; only files with a doubtful end are decoded to make sure.

    Raises:
        InputError: names `path`.
    """
    end = _ENDS.get(header.format)
    with path.open("rb") as file:
        file.seek(-min(64, path.stat().st_size), 2)
        tail = file.read()
    if end is not None and end in tail:
        return
    try:
        with open_picture(path) as picture:
            picture.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); copy the photo again.") from None
