"""Window of a finished run: play, scrub, step."""

import time
from collections.abc import Sequence
from typing import Final

from haptether.view.picture.cameras import CAMERAS
from haptether.view.scene3d.description import Description
from haptether.view.window.window import Window

KEYS: Final = (
    ("space", "play, pause"),
    ("left, right", "a step back, on"),
    ("up, down", "faster, slower"),
    ("Home, End", "to the begin, to the end"),
    ("t", "to the next trip"),
    ("1 2 3 4", "look from " + ", ".join(CAMERAS)),
    ("click the time line", "to that time"),
    ("drag", "turn; with shift move; wheel: nearer"),
    ("?", "these keys"),
    ("q", "end"),
)
"""Keys and mouse actions of the window."""
SPEEDS: Final = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
STEP_S: Final = 0.01


class Player:
    """Playback time, independent of a window."""

    def __init__(self, begin_s: float, end_s: float) -> None:
        self.begin_s, self.end_s = begin_s, end_s
        self.time_s = begin_s
        self.is_playing = False
        self.speed = 1.0

    def advance(self, elapsed_s: float) -> bool:
        """Advance by an elapsed real time; return True if the playback time has changed."""
        if not self.is_playing or elapsed_s <= 0.0:
            return False
        self.go(self.time_s + self.speed * elapsed_s)
        if self.time_s >= self.end_s:
            self.is_playing = False
        return True

    def go(self, time_s: float) -> None:
        """Go to a time in s, limited to the run."""
        self.time_s = min(max(time_s, self.begin_s), self.end_s)

    def toggle(self) -> None:
        """Play or pause; at the end, restart."""
        self.is_playing = not self.is_playing
        if self.is_playing and self.time_s >= self.end_s:
            self.time_s = self.begin_s

    def step(self, steps: int) -> None:
        """Move by a number of steps and pause."""
        self.is_playing = False
        self.go(self.time_s + steps * STEP_S)

    def change_speed(self, by: int) -> None:
        """Change to the next or previous speed."""
        place = min(range(len(SPEEDS)), key=lambda n: abs(SPEEDS[n] - self.speed))
        self.speed = SPEEDS[min(max(place + by, 0), len(SPEEDS) - 1)]

    @property
    def note(self) -> str:
        """State of the playback, in words."""
        return f"{'plays' if self.is_playing else 'paused'} at {self.speed:g}x   ? lists the keys"


class Playback(Window):
    """A picture of a finished run, controlled by keys and clicks."""

    keys = KEYS

    def __init__(
        self, described: Sequence[Description], *, size: tuple[int, int], camera: str, at_s: float | None
    ) -> None:
        super().__init__(described, size=size, camera=camera)
        lines = [one.timeline for one in described]
        self.player = Player(min(line.begin_s for line in lines), max(line.end_s for line in lines))
        if at_s is not None:
            self.player.go(at_s)
        else:
            self.player.is_playing = True
        self._clock_s = time.monotonic()

    def press(self, key: str) -> bool:
        """Handle a key; return False if it is not one of `KEYS`."""
        player = self.player
        line = self.picture.described[0].timeline
        if key == "space":
            player.toggle()
        elif key in {"Left", "Right"}:
            player.step(1 if key == "Right" else -1)
        elif key in {"Up", "Down"}:
            player.change_speed(1 if key == "Up" else -1)
        elif key in {"Home", "End"}:
            player.go(player.begin_s if key == "Home" else player.end_s)
        elif key == "t":
            if (trip_s := line.next_trip(player.time_s)) is not None:
                player.is_playing = False
                player.go(trip_s)
        else:
            return super().press(key)
        self.draw()
        return True

    def tick(self) -> None:
        """Advance with real time and draw."""
        now_s = time.monotonic()
        elapsed_s, self._clock_s = now_s - self._clock_s, now_s
        if self.player.advance(elapsed_s):
            self.draw()

    def click(self, x: int, y: int) -> None:
        """Handle a click at a pixel from the lower left; on the time line, go there."""
        time_s = self.picture.time_at(x, self.picture.size[1] - y)
        if time_s is not None:
            self.player.is_playing = False
            self.player.go(time_s)
            self.draw()

    def update(self) -> None:
        """Move everything to its pose at the playback time."""
        self.picture.update(self.player.time_s, self.player.note)
