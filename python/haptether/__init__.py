"""Haptether: a bilateral teleoperation bridge that keeps a hand safe when the remote end pushes back.

`simulate` runs a scene, `sweep` runs it for many values, `load` reads a recorded run, `replay` applies other settings
to it. Rooms: `haptether.safety`, `haptether.netsim`, `haptether.dynamixel`, `haptether.master`, `haptether.slave`,
`haptether.bridge`, `haptether.studies`. SI units and radians throughout; a positive force pushes along +x.
"""

# No imports here, so that a loading command can handle Ctrl-C early.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from haptether._core import __version__
    from haptether.bridge import load, replay, simulate, sweep

__all__ = ["__version__", "load", "replay", "simulate", "sweep"]


def __getattr__(name: str) -> object:
    # Importing the version or one room must not load the bridge and NumPy.
    if name == "__version__":
        from haptether import _core  # noqa: PLC0415

        return _core.__version__
    if name in {"load", "replay", "simulate", "sweep"}:
        from haptether import bridge  # noqa: PLC0415

        return getattr(bridge, name)
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
