"""Smaller files, by the package gaussforge, all at once: .spz, .sog and .compressed.ply."""

import gzip
import io
import json
import math
import zipfile
from dataclasses import replace

import torch

from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.ply import ANTIALIASED, Content, pieces

OPENGL = Similarity(torch.diag(torch.tensor([1.0, -1, -1]).double()), torch.zeros(3).double(), 1.0)
"""To .spz's axes, right, up, back, from .ply's: right, down, front (nianticlabs/spz, README). Its readers
turn them back, but gaussforge 0.6 does not turn them."""
MOST_SOG = 1 << 16
"""Gaussians with harmonics that gaussforge packs into a .sog in 7 s. Of more it shares them:
70,000 took more than 6 minutes."""
WIDEST_SPZ = math.exp(255 / 16 - 10)
"""Units: the largest standard deviation that a .spz holds (nianticlabs/spz, README)."""
BYTES_AT_ONCE = 1000  # of RAM that a Gaussian of degree 3 needs while it is packed (.spz), measured


def check_installed() -> None:
    """Raises UserError where gaussforge is not there."""
    try:
        import gaussforge  # noqa: F401
    except ImportError as error:
        raise UserError(f"gaussforge is not there ({error}): pip install 'abcd-ns[export]'.") from None


def packed(kind: str, content: Content) -> bytes:
    """A file; `kind` is "spz", "sog" or "compressed.ply". Raises UserError."""
    import gaussforge

    parts = content.parts
    if kind == "spz":
        parts = map(OPENGL.gaussians, parts)
    elif kind == "compressed.ply":
        parts = map(_transposed, parts)
    ply = b"".join(pieces(replace(content, parts=parts, antialiased=False)))
    found = gaussforge.GaussForge().convert(ply, "ply", kind)
    if "error" in found:
        raise UserError(f".{kind} cannot be written: gaussforge says {found['error']}.")
    return _marked(found["data"], kind) if content.antialiased else found["data"]


def _marked(data: bytes, kind: str) -> bytes:
    """The file with its format's mark of antialiased training, which gaussforge 0.6 never sets."""
    if kind == "compressed.ply":
        return data.replace(b"\n", f"\n{ANTIALIASED}\n".encode(), 1)
    if kind == "spz":
        content = bytearray(gzip.decompress(data))
        content[14] |= 1  # the flags of its header
        return gzip.compress(content, mtime=0)
    made = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(made, "w") as new:
        for file in old.infolist():  # with its time, so that the same scene is the same file
            content = old.read(file)
            if file.filename == "meta.json":
                content = json.dumps({**json.loads(content), "antialias": True})
            new.writestr(file, content)
    return made.getvalue()


def _transposed(gaussians: Gaussians) -> Gaussians:
    """Undo in advance what gaussforge 0.6 does to a .compressed.ply: it writes red, green, blue of a harmonic
    together, where readers expect all of red, then of green and of blue, as in .ply."""
    rest = gaussians.features_rest
    return replace(gaussians, features_rest=rest.transpose(1, 2).reshape(rest.shape))
