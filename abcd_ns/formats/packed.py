"""Smaller files, by the package gaussforge, all at once: .spz, .sog and .compressed.ply."""

import gzip
import io
import json
import math
import zipfile
from collections.abc import Iterable

import numpy as np
import torch

from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.ply import ANTIALIASED, columns, header, rows

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


def packed(
    count: int, sh_degree: int, kind: str, parts: Iterable[Gaussians], antialiased: bool = False
) -> bytes:
    """A file of `count` Gaussians; `kind` is "spz", "sog" or "compressed.ply". Raises UserError."""
    import gaussforge

    table, done = np.empty((count, len(columns(sh_degree))), dtype="<f4"), 0
    for part in parts:
        gaussians = OPENGL.gaussians(part) if kind == "spz" else part
        table[done : done + len(gaussians)] = rows(gaussians)
        done += len(gaussians)
    if kind == "compressed.ply":
        _transpose(table, sh_degree)
    whole = header(count, sh_degree) + table.tobytes()
    del table
    found = gaussforge.GaussForge().convert(whole, "ply", kind)
    if "error" in found:
        raise UserError(f".{kind} cannot be written: gaussforge says {found['error']}.")
    return _marked(found["data"], kind) if antialiased else found["data"]


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
        files = {name: old.read(name) for name in old.namelist()}
        files["meta.json"] = json.dumps({**json.loads(files["meta.json"]), "antialias": True})
        for name, content in files.items():
            new.writestr(name, content)
    return made.getvalue()


def _transpose(table: np.ndarray, sh_degree: int) -> None:
    """Undo in advance what gaussforge 0.6 does to a .compressed.ply: it writes red, green, blue of a harmonic
    together, where readers expect all of red, then of green and of blue, as in .ply."""
    first, rest = columns(sh_degree).index("f_dc_2") + 1, 3 * ((sh_degree + 1) ** 2 - 1)
    harmonics = table[:, first : first + rest]
    harmonics[:] = harmonics.reshape(len(table), -1, 3).transpose(0, 2, 1).reshape(harmonics.shape)
