"""What a benchmark found, as JSON beside what it was asked for, the machine and the versions."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from abcd_ns.machine import describe_machine, describe_versions


def write_runs(out: Path | None, asked: Mapping[str, Any], runs: Sequence[Any]) -> None:
    """Write the file; nothing where none is wanted.

    Args:
        runs: a dataclass each.
    """
    if out is None:
        return
    told = {"machine": asdict(describe_machine()), "versions": asdict(describe_versions())}
    found = {**told, **asked, "runs": [asdict(run) for run in runs]}
    out.write_text(json.dumps(found, indent=1) + "\n")
