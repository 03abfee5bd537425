"""Haptether: a bilateral teleoperation bridge that keeps a hand safe when the remote end pushes back.

`simulate` runs a scene, `sweep` runs it for many values of its numbers, `load` reads a recorded run, and
`replay` puts it through other settings. Rooms:
`haptether.safety`, `haptether.netsim`, `haptether.dynamixel`, `haptether.master`, `haptether.slave`,
`haptether.bridge`, `haptether.studies`. SI units and radians throughout; a positive force pushes along +x.
"""

# Without imports: a command that is only being loaded takes Ctrl-C as soon as this is done.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from haptether._core import __version__
    from haptether.bridge import load, replay, simulate, sweep

__all__ = ["__version__", "load", "replay", "simulate", "sweep"]


def __getattr__(name: str) -> object:
    # Whoever imports only the version, or one room, does not wait for the bridge and NumPy.
    if name == "__version__":
        from haptether import _core  # noqa: PLC0415

        return _core.__version__
    if name in {"load", "replay", "simulate", "sweep"}:
        from haptether import bridge  # noqa: PLC0415

        return getattr(bridge, name)
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
