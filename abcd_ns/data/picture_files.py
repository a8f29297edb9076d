"""Looks at picture files without decoding them: size, kind, and whether the end is there."""

import os
import stat
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path, PureWindowsPath
from typing import Literal, TypeVar

from PIL import ExifTags, Image, PngImagePlugin, UnidentifiedImageError

from abcd_ns.data.input_errors import InputError

T = TypeVar("T")

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff"})
"""What counts as a photo when a folder is listed."""

UNPOSED = frozenset({".webp"})  # of these, what COLMAP does not read
UNREAD = frozenset({".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2"})
"""Pictures that cameras and phones write, and nothing here reads."""

_HIDDEN = (".", "@eaDir", "__MACOSX")  # how names begin that no program lists as a photo
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
"""What is read, by content and not by name. Pillow knows more, some of which it gives to other programs."""
Image.MAX_IMAGE_PIXELS = 500_000_000  # Pillow's own limit is 89 million: aerial cameras have up to 450
PngImagePlugin.MAX_TEXT_CHUNK = 64 << 20  # Pillow's own limit is 1 MiB: editors write longer histories
_MODES = frozenset({"RGB", "RGBA", "L", "LA", "P", "1"})
_ENDS = {"JPEG": b"\xff\xd9", "MPO": b"\xff\xd9", "PNG": b"IEND\xaeB`\x82"}
_PNG_BIT_DEPTH_BYTE = 24


def check_regular(path: Path, kind: str = "photo") -> None:
    """Refuse what must not be opened: a missing file, a folder, a pipe (it would block), no bytes."""
    try:
        status = path.stat()
    except OSError as error:
        what = "is a link to nothing" if path.is_symlink() else f"cannot be read ({error.strerror})"
        raise InputError(f"{path} {what}; copy the {kind} there.") from None
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is not a regular file; copy the {kind} there.")
    if status.st_size == 0:
        raise InputError(f"{path} is empty; copy the {kind} again.")


def check_two_files(found: Path, photo: str, mask: str) -> None:
    """Refuse one file that was found for both a photo and its mask, if their names end otherwise."""
    if PureWindowsPath(photo).suffix.lower() != PureWindowsPath(mask).suffix.lower():
        raise InputError(f"{found} is all there is of {photo} and of its mask; copy both there.")


class FileFinder:
    """Finds files of a folder by what another file, `said_by`, calls them, as written on another machine
    perhaps. No path leads out of the folder. The check is by name: a link inside may point anywhere."""

    def __init__(self, folder: Path, said_by: Path):
        self.folder, self.said_by, self._root = folder, said_by, Path(os.path.abspath(folder))
        self._renamed: dict[str, Path] = {}

    def find(self, name: str, moved: bool = True) -> Path:
        """The file of that name; or else the only one that differs in separators, case, Unicode form or a
        picture's ending; or else the path as it is named. If `moved`, the folders that come first in the name
        may be missing, as those of another machine."""
        try:
            os.fsencode(name)
        except UnicodeEncodeError:
            raise InputError(f"{self.said_by}: no file can have the name {name}; correct the path.") from None
        path = Path(os.path.abspath(self._root / name))
        leaves = "\0" in name or not path.is_relative_to(self._root)
        if not leaves and os.path.lexists(path):
            return path
        if (meant := meant_by(name, self._files, moved)) is not None:
            self._renamed[name] = meant
            return meant
        if leaves:
            leads = f"the path {name} leads out of {self.folder}"
            raise InputError(f"{self.said_by}: {leads}; move the file inside.")
        return path

    @property
    def notes(self) -> list[str]:
        """How many files are read under other names than they were called by, if there are any."""
        if not self._renamed:
            return []
        name, path = next(iter(self._renamed.items()))
        example = f"{name} is {path.relative_to(self._root)}"
        return [f"{self.said_by}: {len(self._renamed)} files have other names ({example}, ...)."]

    @cached_property
    def _files(self) -> dict[str, set[Path]]:
        """All files, by their path inside the folder."""
        paths = visible_files(self._root)
        return by_loose_name((path.relative_to(self._root).as_posix(), path) for path in paths)


def by_loose_name(named: Iterable[tuple[str, T]]) -> dict[str, set[T]]:
    """What has a name, for `meant_by`; pictures by their names without the ending, too."""
    found: dict[str, set[T]] = {}
    for name, thing in named:
        for key in _loosely(name):
            found.setdefault(key, set()).add(thing)
    return found


def meant_by(name: str, found: Mapping[str, set[T]], moved: bool = True) -> T | None:
    """The only one whose name differs from `name` as `FileFinder.find` says; None if none or several do."""
    parts = [part for part in PureWindowsPath(name).parts if part != ".."]
    for start in range(len(parts) if moved else 1):
        key, stem = _loosely("/".join(parts[start:]))
        meant = found.get(key) or found.get(stem, ())
        if len(meant) == 1:
            return next(iter(meant))
    return None


def visible_files(folder: Path) -> Iterator[Path]:
    """Files below a folder, through links, too. Not what systems hide: macOS's ._a.jpg, Synology's @eaDir."""
    root, seen = Path(os.path.realpath(folder)), set[Path]()
    for at, folders, names in os.walk(folder, followlinks=True):
        place = Path(os.path.realpath(at))
        if place in seen or place in root.parents:  # a link that leads there again, or up
            folders.clear()
            continue
        seen.add(place)
        folders[:] = [name for name in folders if not name.startswith(_HIDDEN)]
        yield from (Path(at, name) for name in names if not name.startswith(_HIDDEN))


def _loosely(path: str) -> tuple[str, str]:
    """What a path is compared by; and without the ending, if it is a picture's."""
    key = unicodedata.normalize("NFC", path).casefold()
    stem, ending = os.path.splitext(key)
    return key, stem if ending in SUFFIXES | UNREAD else key


def open_picture(path: Path) -> Image.Image:
    """Pillow's picture, not yet decoded, of one of FORMATS; else OSError, SyntaxError or ValueError."""
    return Image.open(path, formats=FORMATS)


def has_alpha(picture: Image.Image) -> bool:
    """Whether some of its pixels may be transparent."""
    return "A" in picture.getbands() or "transparency" in picture.info


def orientation(picture: Image.Image) -> int:
    """EXIF orientation, 1 to 8; 1 is upright."""
    return picture.getexif().get(ExifTags.Base.Orientation, 1)


def undecodable(path: Path, error: Exception) -> InputError:
    """What to say of a file whose header is sound and whose pixels are not."""
    return InputError(f"{path} cannot be decoded ({error}); copy it again.")


def read_size(path: Path, kind: Literal["photo", "mask"] = "photo") -> tuple[int, int]:
    """(width, height) of a photo or mask as stored: EXIF orientation is not applied, as COLMAP does not.
    Refuses photos that 8-bit RGB would change. Not thread-safe (it sets warning filters)."""
    check_regular(path, kind)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with open_picture(path) as picture:
                if kind == "photo":
                    _check_kind(path, picture)
                return picture.size
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        more = " and make the model again" if kind == "photo" else ""
        raise InputError(f"{path} has more than 500 Mpx; reduce the {kind}{more}.") from None
    except UnidentifiedImageError:
        raise InputError(f"{path} is not a picture of a known kind; save it as JPEG or PNG.") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); copy the {kind} again.") from None


def is_turned(path: Path) -> bool:
    """Whether the EXIF orientation of a readable picture swaps width and height."""
    with open_picture(path) as picture:
        return orientation(picture) in (5, 6, 7, 8)


def _check_kind(path: Path, picture: Image.Image) -> None:
    """Refuse pictures whose conversion to 8-bit sRGB would be a guess."""
    bits = 16 if picture.mode.startswith(("I", "F")) else 8
    # Pillow cuts 16-bit RGB to 8 bits without a word, so look at the file.
    if picture.format == "PNG":
        with path.open("rb") as file:
            bits = max(bits, file.read(_PNG_BIT_DEPTH_BYTE + 1)[_PNG_BIT_DEPTH_BYTE])
    elif picture.format == "TIFF":
        bits = max(bits, *picture.tag_v2.get(ExifTags.Base.BitsPerSample, (8,)))
    if bits > 8:
        raise InputError(f"{path} has more than 8 bits a channel; convert it to 8 bits.")
    if picture.mode not in _MODES:
        raise InputError(f"{path} is a {picture.mode} picture; convert it to RGB.")


def read_whole(path: Path) -> tuple[int, int]:
    """`read_size` of a photo. Refuses a cut file, too: where the end is doubtful, the photo is decoded."""
    size = read_size(path)
    with path.open("rb") as file:
        file.seek(-min(64, path.stat().st_size), 2)
        tail = file.read()
    try:
        with open_picture(path) as picture:
            end = _ENDS.get(picture.format)
            if end is None or end not in tail:
                picture.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); copy the photo again.") from None
    return size
