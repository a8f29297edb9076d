"""The methods that `ns-train` offers, as nerfstudio's entry points name them.

nerfstudio loads this for each of its commands, other methods' too, and an exception here would end them all.
So where something that ABCD needs is missing or does not start, its methods say so when they are asked for.
"""

import sys
from dataclasses import dataclass

import tyro
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification
from nerfstudio.utils.rich_utils import CONSOLE

from abcd_ns.errors import IMPORT_TROUBLE, missing
from abcd_ns.nerfstudio.flags import check_config, trains_ours
from abcd_ns.terminal import print_plain

try:
    from abcd_ns.data.input_errors import exit_on_user_error
    from abcd_ns.nerfstudio import method_configs as _methods
    from abcd_ns.nerfstudio.options import refuse_flags
except IMPORT_TROUBLE as error:
    _methods, _trouble = None, missing(error)
else:
    with exit_on_user_error():  # before tyro and nerfstudio read them, which know no reasons
        check_config(sys.argv)
        _named = getattr(_methods, sys.argv[1].replace("-", "_"), None) if trains_ours(sys.argv) else None
        if _named is not None:
            refuse_flags(sys.argv[2:], _named.config)


@dataclass
class UnavailableConfig(TrainerConfig):
    """In place of a method that cannot start here."""

    trouble: tyro.conf.Suppress[str] = ""
    """Why not, and what helps."""

    def print_to_terminal(self) -> None:
        """Say so and end; it is the first that `ns-train` calls."""
        print_plain(f"error: {self.trouble}", CONSOLE, "red")
        raise SystemExit(2)


def _method(name: str) -> MethodSpecification:
    if _methods is not None:
        return getattr(_methods, name)
    config = UnavailableConfig(method_name=name.replace("_", "-"), trouble=_trouble)
    return MethodSpecification(config, f"[cannot start here] {_trouble}")


abcd = _method("abcd")
abcd_ablated = _method("abcd_ablated")
abcd_partition = _method("abcd_partition")
abcd_exact = _method("abcd_exact")
abcd_paper = _method("abcd_paper")
abcd_monolithic = _method("abcd_monolithic")
