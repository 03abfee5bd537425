"""Both ends in 3D for the pages: one description for all pages, computed on its own thread."""

import json
import threading
import time
from queue import Empty, Full, Queue
from typing import Any

import numpy as np

from haptether.bridge import TelemetryHello, TelemetryMessage
from haptether.view.page.geometry import geometry, packed
from haptether.view.picture.cameras import CAMERAS
from haptether.view.scene3d.description import Description
from haptether.view.scene3d.live import LiveDescription

FRAME_S = 1.0 / 20
"""Frame period; a browser without a graphics card draws no faster."""
HISTORY_S = 2.0
CLOSE_S = 0.2
"""Longest wait for the thread on close."""
WAITING = 1024
"""Capacity of the message queue; messages beyond it are not drawn."""


class Bodies:
    """Drawing of the sides for the pages: bodies once, then their poses at most 20 times a second.

    Telemetry readers and page servers never wait for it: messages enter a bounded queue, and pages take the latest
    result.
    """

    def __init__(self) -> None:
        self.geometry = b"{}"
        """JSON of bodies, trails, views, legend and notes, with their `generation`."""
        self.frame: dict[str, Any] | None = None
        """Poses: `generation`, `time_s`, `poses` and `trails`; None before the first sample."""
        self.is_watched = False
        """True while a page is open; otherwise no frames are computed."""
        self._queue: Queue[tuple[TelemetryHello, TelemetryMessage | None, float]] = Queue(WAITING)
        self._hellos: dict[str, TelemetryHello] = {}
        self._live: LiveDescription | None = None
        self._generation = 0
        """Counter over all runs shown."""
        self._shown: tuple[LiveDescription, int, float] | None = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="console-bodies", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread."""
        self._closed.set()
        self._thread.join(CLOSE_S)

    def take(self, hello: TelemetryHello, message: TelemetryMessage | None = None) -> None:
        """Queue a message of the run `hello`; without a message, begin that run. Never waits."""
        try:
            self._queue.put_nowait((hello, message, time.monotonic()))
        except Full:
            return

    def _run(self) -> None:
        due = time.monotonic()
        while not self._closed.is_set():
            try:
                self._take_all()
                live = self._live
                if self.is_watched and live is not None and live.has_begun and self._shown != _state(live):
                    self._show(live)
            except Exception as error:  # a drawing that fails must not stop the page
                self._live = self._shown = None
                self._generation += 1
                self.geometry = self._text(None, str(error))
                self.frame = {"generation": self._generation, "poses": "", "trails": []}
            due = max(due + FRAME_S, time.monotonic())
            self._closed.wait(due - time.monotonic())

    def _take_all(self) -> None:
        for _ in range(WAITING):
            try:
                hello, message, received_s = self._queue.get_nowait()
            except Empty:
                return
            if message is None:
                # The other side's pose comes with its next sample.
                self._hellos[hello.side] = hello
                self._live = LiveDescription(*self._hellos.values(), history_s=HISTORY_S)
            elif self._live is not None and self._hellos.get(hello.side) is hello:
                self._live.take(message, hello.side, received_s=received_s)

    def _show(self, live: LiveDescription) -> None:
        described = live.description
        shown, self._shown = self._shown, _state(live)
        if shown is None or shown[:2] != self._shown[:2]:
            self._generation += 1
            self.geometry = self._text(described)
        poses = [part.pose(live.time_s) for part in described.parts]
        rows = [np.full(12, np.nan) if at is None else at[:3].ravel() for at in poses]
        self.frame = {
            "generation": self._generation,
            "time_s": live.time_s,
            "poses": packed(rows),
            "trails": [packed(trail.until(live.time_s)) for trail in described.trails],
        }

    def _text(self, described: Description | None, *notes: str) -> bytes:
        whole: dict[str, Any] = {"generation": self._generation, "camera": CAMERAS["front"]}
        if described is None:
            whole |= {"parts": [], "trails": [], "views": {}, "legend": [], "notes": notes}
        else:
            whole |= {
                "parts": [geometry(part) for part in described.parts],
                "trails": [{"station": one.station, "colour": one.colour} for one in described.trails],
                "views": {name: [low.tolist(), high.tolist()] for name, (low, high) in described.views.items()},
                "legend": [
                    *([arrow.station, arrow.label, arrow.colour] for arrow in described.arrows),
                    *([trail.station, trail.label, trail.colour] for trail in described.trails),
                ],
                "notes": (*described.notes, *notes),
            }
        return json.dumps(whole, allow_nan=False, separators=(",", ":")).encode()


def _state(live: LiveDescription) -> tuple[LiveDescription, int, float]:
    return live, live.generation, live.time_s
