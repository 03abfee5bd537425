"""View directions of pictures, windows and pages."""

from typing import Final

CAMERAS: Final = {
    "front": (0.18, -1.0, 0.42),
    "side": (1.0, -0.25, 0.3),
    "top": (0.0, -0.02, 1.0),
    "corner": (0.85, -0.85, 0.6),
}
"""Directions from the scene to the camera; keys 1 to 4 of the window."""
