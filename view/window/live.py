"""Window of a live run."""

import time
from typing import Final

from haptether.view.following import Following
from haptether.view.picture.cameras import CAMERAS
from haptether.view.window.window import Window

KEYS: Final = (
    ("1 2 3 4", "look from " + ", ".join(CAMERAS)),
    ("drag", "turn; with shift move; wheel: nearer"),
    ("?", "these keys"),
    ("q", "end; the run goes on"),
)
"""Keys and mouse actions of the window; none affects the run."""
FRAME_S: Final = 1.0 / 30.0
LINE_S: Final = 0.2
"""Period of time lines, which cost more than moving parts."""


class LiveWindow(Window):
    """A live picture at 30 Hz, until the run ends or the window is closed.

    Args:
        following: Reader of the run's telemetry.
        size: Width and height in pixels.
        camera: One of `CAMERAS`.
    """

    keys = KEYS

    def __init__(self, following: Following, *, size: tuple[int, int], camera: str) -> None:
        self._following = following
        self._generation = following.live.generation
        self._frame_s = self._line_s = 0.0
        self.frames = 0
        super().__init__([following.live.description], size=size, camera=camera)

    def update(self) -> None:
        """Move everything to its current pose."""
        live, now_s = self._following.live, time.monotonic()
        if live.generation != self._generation or now_s >= self._line_s + LINE_S:
            self._generation, self._line_s = live.generation, now_s
            self.picture.renew(live.refresh())
        lost = f"   {live.lost_ticks} ticks missed" if live.lost_ticks else ""
        self.picture.update(live.time_s, f"live{lost}   ? lists the keys")

    def tick(self) -> None:
        """Process new messages; draw if due."""
        self._following.take()
        now_s = time.monotonic()
        if now_s >= self._frame_s + FRAME_S:
            # Do not catch up after a slow frame.
            self._frame_s = max(self._frame_s + FRAME_S, now_s - FRAME_S)
            self.frames += 1
            self.draw()
        if self._following.is_over:
            self.close()
