"""A guard in front of viser's server: who may talk to the viewer, and about what.

viser 0.2.7, which nerfstudio 1.1.5 pins, serves any readable file through `GET /../..`, looks at neither
Origin nor Host, lets every client open a public tunnel, and leaves a client behind that sent a bad frame.
`rules` says what is admitted and knows no server. `server` stands in for `websockets.serve` in a private
module of viser's, as there is no hook. With a viser that is built otherwise it does nothing, and says that.
"""

from abcd_ns.viewer.guard.rules import Rules
from abcd_ns.viewer.guard.server import install, rules_of

__all__ = ["Rules", "install", "rules_of"]
