"""Haptether: a bilateral teleoperation bridge that keeps a hand safe when the remote end pushes back.

Rooms: `haptether.safety`, `haptether.netsim`, `haptether.master`, `haptether.slave`, `haptether.bridge`,
`haptether.studies`. SI units and radians throughout; a positive force pushes along +x.
"""

from haptether._core import __version__

__all__ = ["__version__"]
