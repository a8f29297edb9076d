"""Joins a Ray cluster, or starts one that nobody outside this machine can reach."""

import importlib.util
import os
import secrets
import sys
from contextlib import suppress
from typing import Any

from abcd_ns.cluster.assignment import WorkersError
from abcd_ns.errors import first_line

LOOPBACK = "127.0.0.1"
ON_LOOPBACK = ("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
"""Without it Ray takes an interface that others can reach, whatever address it is given."""
STARTS = 3  # attempts to start Ray, which gives its own processes half a minute


def check_installed() -> None:
    """Raises WorkersError where Ray cannot be imported."""
    if importlib.util.find_spec("ray") is None:
        raise WorkersError("Workers need Ray, which is not installed: pip install 'abcd-ns[cluster]'.")


def connect(address: str | None, *, cores: int) -> None:
    """Join the cluster whose head is at `address` (host:port), or start one here for as long as we live.

    One that is started listens on 127.0.0.1 alone, and asks for a token that only its own processes know. A
    cluster's token is read where Ray looks for it: RAY_AUTH_TOKEN, or ~/.ray/auth_token. WorkersError says
    that there is no Ray, no such cluster, or one that refuses us.
    """
    check_installed()
    keep_to_ourselves(address is None)
    import ray

    ray.shutdown()  # of an earlier run of this process
    options: dict[str, Any] = {"address": address}
    if address is None:
        options = {"num_cpus": cores, "include_dashboard": False, "_node_ip_address": LOOPBACK}
    failed = f"No Ray cluster answers at {address}" if address else "No Ray could be started here"
    for left in reversed(range(1 if address else STARTS)):
        try:
            ray.init(**options, log_to_driver=False, logging_level="CRITICAL")
            return
        except Exception as error:
            with suppress(Exception):
                ray.shutdown()
            if not left:
                raise WorkersError(f"{failed}: {first_line(error)}") from error


def keep_to_ourselves(starts: bool) -> None:
    """Set what Ray reads from the environment; before it is imported, if a cluster `starts` here."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # without num_gpus, leave GPUs visible
    if not starts:
        return
    if "ray" in sys.modules and os.environ.get(ON_LOOPBACK[0]) != ON_LOOPBACK[1]:
        fix = f"set {'='.join(ON_LOOPBACK)} and RAY_AUTH_MODE=token in the environment"
        early = "Ray was imported before workers were asked for"
        raise WorkersError(f"{early}, and would listen to strangers: {fix}.")
    os.environ["RAY_AUTH_MODE"] = "token"
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
    os.environ.update([ON_LOOPBACK])
