"""3D Systems Touch through OpenHaptics: driver `touch`."""

from haptether.master.touch.driver import Touch

__all__ = ["Touch"]
