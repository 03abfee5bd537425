"""Devices that exert a force of their own while they are open, and the announcements about them."""

import sys


def exerts_by_itself(device: object) -> bool:
    """Return true if a driver says that its device exerts a force between `open` and `close` even at zero command."""
    return bool(getattr(device, "exerts_by_itself", False))


def announce_end(name: str, *, closed: bool) -> None:
    """Say if a device that exerts by itself is closed."""
    said = "is closed: its force has ended, but for what the driver names above"
    if not closed:
        said = "is NOT known to be closed: it may still exert, switch it off"
    print(f"{name}: {said}", file=sys.stderr, flush=True)
