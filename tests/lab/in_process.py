"""Jobs done in this process: starting one for each would import torch and nerfstudio for seconds."""

import runpy
import subprocess
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from types import SimpleNamespace

import pytest

from abcd_ns.lab.runs import runner


def do_here(command: list[str], stdout, **_) -> nullcontext:
    """As `subprocess.Popen` of a process that has ended; what goes wrong in it is raised here."""
    *_, module, job = command  # python -m MODULE JOB
    code = 0
    with open(stdout.name, "a") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("sys.argv", [module, job])
                patch.setattr(runner, "end_with_parent", lambda: None)
                runpy.run_module(module, run_name="__main__")
        except SystemExit as end:
            code = end.code or 0
    return nullcontext(SimpleNamespace(wait=lambda: code, terminate=lambda: None))


def jobs_in_this_process(patch, first_is_real: bool = False) -> None:
    """Have `runner` do its jobs here, all or all but the first."""
    kinds = iter([subprocess.Popen] * first_is_real)
    known = {"DEVNULL": subprocess.DEVNULL, "STDOUT": subprocess.STDOUT}

    def start(command: list[str], **options):
        return next(kinds, do_here)(command, **options)

    patch.setattr(runner, "subprocess", SimpleNamespace(Popen=start, **known))
