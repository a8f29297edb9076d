"""Jobs done in this process: starting one for each would import torch and nerfstudio for seconds."""

import runpy
import subprocess
from contextlib import redirect_stderr, redirect_stdout
from types import SimpleNamespace

import pytest

from abcd_ns.lab.runs import runner


class Done:
    """As `subprocess.Popen` of a process that has ended; what goes wrong in it is raised here."""

    def __init__(self, command: list[str], stdout, **_) -> None:
        *_, module, job = command  # python -m MODULE JOB
        with open(stdout.name, "a") as log, redirect_stdout(log), redirect_stderr(log):
            try:
                with pytest.MonkeyPatch.context() as patch:
                    patch.setattr("sys.argv", [module, job])
                    runpy.run_module(module, run_name="__main__")
                self.returncode = 0
            except SystemExit as end:
                self.returncode = end.code or 0

    def poll(self) -> int:
        return self.returncode


def jobs_in_this_process(patch, first_is_real: bool = False) -> None:
    """Have `runner` do its jobs here, all or all but the first."""
    kinds = iter([subprocess.Popen] * first_is_real)

    def start(command: list[str], **options):
        return next(kinds, Done)(command, **options)

    known = {"DEVNULL": subprocess.DEVNULL, "STDOUT": subprocess.STDOUT}
    patch.setattr(runner, "subprocess", SimpleNamespace(Popen=start, **known))
