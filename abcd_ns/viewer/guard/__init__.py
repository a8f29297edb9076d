"""A guard in front of viser's server: who may talk to the viewer, and about what.

nerfstudio 1.1.5 pins viser 0.2.7, which serves any readable file through `GET /../..`, looks at neither
Origin nor Host, lets every client open a public tunnel, and leaves a client behind that sent a bad frame.
viser 1 serves its own files only from 1.0.25 on; the rest is as it was. So the guard works with both: `rules`
says what is admitted and knows no server, `server` puts it in front of whatever viser server this process
starts. It stands in for `websockets.serve` in a private module of viser's, as there is no hook. With a viser
that is built otherwise it does nothing, and says that.
"""

from abcd_ns.viewer.guard.rules import Rules
from abcd_ns.viewer.guard.server import install, rules_of

__all__ = ["Rules", "install", "rules_of"]
