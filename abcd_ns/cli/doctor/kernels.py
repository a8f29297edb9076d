"""The compiled code that training runs on: what is built, what could be, and whether it computes right.

Nothing is built here, and no folder is made.
"""

import importlib.util
import logging
import os
import re
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from abcd_ns.errors import first_line
from abcd_ns.machine import output_of

EXTENSION = "gsplat_cuda"
"""gsplat's name for what it compiles at first use."""


def look_at_kernels(on_gpu: bool) -> dict[str, Any]:
    """The fields of Facts from `folder` on. Needs a torch that starts.

    Args:
        on_gpu: whether there is a CUDA device to check gsplat's kernels on.
    """
    from abcd_ns.engine.kernels import find_compiler, kernels_folder
    from abcd_ns.engine.kernels.native import library_path
    from abcd_ns.engine.render import TorchRasterizer, self_check
    from abcd_ns.nerfstudio.metrics import lpips_missing

    extension, built = find_extension(), library_path().is_file()
    checks = {"torch on cpu": lambda: self_check(TorchRasterizer(use_native=built), "cpu")}
    if extension is not None and on_gpu:
        checks["gsplat on cuda"] = lambda: check_gsplat(extension)
    agree, failed = {}, {}
    for name, check in checks.items():
        try:
            agree[name] = check()
        except (RuntimeError, ImportError, OSError, AttributeError) as error:
            failed[name] = first_line(error)
    nvcc = output_of("nvcc", "--version")
    return {
        "folder": str(kernels_folder()),
        "built": built,
        "gsplat": None if extension is None else str(extension),
        "compiler": find_compiler(),
        "nvcc": nvcc and (re.findall(r"release ([\d.]+)", nvcc) or ["unknown"])[0],
        "ninja": shutil.which("ninja") is not None,
        "self_check": agree,
        "failed": failed,
        "lpips_missing": lpips_missing(),
    }


def find_extension() -> Path | None:
    """gsplat's CUDA kernels, from its wheel or from an earlier run."""
    package = importlib.util.find_spec("gsplat")
    for folder in (package.submodule_search_locations or ()) if package else ():
        for path in sorted(Path(folder).glob("csrc*.so")):
            return path
    path = build_folder() / f"{EXTENSION}.so"
    return path if path.is_file() else None


def build_folder() -> Path:
    """Where torch compiles gsplat's extension. Its own `_get_build_directory` would make the folder."""
    import torch

    # Its import says that there is no GPU, where there is none.
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)
    from torch.utils.cpp_extension import get_default_build_root

    if root := os.environ.get("TORCH_EXTENSIONS_DIR"):
        return Path(root) / EXTENSION
    cuda, hip = torch.version.cuda, torch.version.hip
    kind = f"rocm{hip.replace('.', '')}" if hip else f"cu{cuda.replace('.', '')}" if cuda else "cpu"
    python = f"py{sys.version_info.major}{sys.version_info.minor}{sys.abiflags}"
    return Path(get_default_build_root()) / f"{python}_{kind}" / EXTENSION


def check_gsplat(extension: Path) -> float:
    """Have gsplat take this file, and compare with the reference.

    gsplat's own loader compiles anew where it finds that something changed.
    """
    if extension.stem == EXTENSION and "gsplat.cuda._backend" not in sys.modules:
        spec = importlib.util.spec_from_file_location(EXTENSION, extension)
        backend = ModuleType("gsplat.cuda._backend")
        backend._C = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(backend._C)
        sys.modules[backend.__name__] = backend
    from abcd_ns.engine.render import self_check
    from abcd_ns.engine.render.cuda.backend import GsplatRasterizer

    return self_check(GsplatRasterizer(), "cuda")
