"""A run that goes on in a window."""

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
"""What the window listens to: nothing of it reaches the run."""
FRAME_S: Final = 1.0 / 30.0
LINE_S: Final = 0.2
"""Between two time lines, which cost more than what moves."""


class LiveWindow(Window):
    """A picture of now, at 30 Hz, until the run ends or the window is closed.

    Args:
        following: Who reads what the run sends.
        size: Width and height in pixels.
        camera: One of `CAMERAS`.
    """

    keys = KEYS

    def __init__(self, following: Following, *, size: tuple[int, int], camera: str) -> None:
        self._following = following
        self._generation = following.live.generation
        self._frame_s = self._line_s = 0.0
        self.frames = 0
        """That were drawn."""
        super().__init__([following.live.description], size=size, camera=camera)

    def update(self) -> None:
        """Puts everything where it is now."""
        live, now_s = self._following.live, time.monotonic()
        if live.generation != self._generation or now_s >= self._line_s + LINE_S:
            self._generation, self._line_s = live.generation, now_s
            self.picture.renew(live.refresh())
        lost = f"   {live.lost_ticks} ticks missed" if live.lost_ticks else ""
        self.picture.update(live.time_s, f"live{lost}   ? lists the keys")

    def tick(self) -> None:
        """Takes what came, and draws it when it is time to."""
        self._following.take()
        now_s = time.monotonic()
        if now_s >= self._frame_s + FRAME_S:
            # Not caught up with where a frame took long.
            self._frame_s = max(self._frame_s + FRAME_S, now_s - FRAME_S)
            self.frames += 1
            self.draw()
        if self._following.is_over:
            self.close()
