"""Telemetry of a live side for the console, read on a separate thread, with the latest chart rows."""

import threading
from pathlib import Path
from typing import Any, Protocol

from haptether.bridge import TelemetryEnd, TelemetryHello, TelemetryMessage, TelemetryReader, TelemetrySample
from haptether.view.console.pair import side_id
from haptether.view.console.summary import summary
from haptether.view.terminal.state import SideState

RETRY_S = 0.5
"""Time in s between connection attempts."""
CLOSE_S = 0.2
"""Timeout in s for the thread at the end."""
PLACES = ("position", "command")
VECTORS = (
    "velocity",
    "rendered_force",
    "safety_force",
    "device_force",
    "grasp_force",
    "environment_force",
)
"""Vectors of the charts, if a side has them."""


class Listener(Protocol):
    """Receiver of telemetry; called on the thread of the reader, which it must not block."""

    def __call__(self, hello: TelemetryHello, message: TelemetryMessage | None = None, /) -> None:
        """Take a message of the run with the given `hello`, or the start of that run."""


class SideFeed:
    """Reader of the telemetry at `path` until closed; it reconnects when another run begins.

    Args:
        path: Socket of `--telemetry`.
        name: Name of the side until it is known.
        listener: Receiver of each message.
        pair: Name of its pair; empty with one pair only.
    """

    def __init__(self, path: Path, name: str, listener: Listener, pair: str = "") -> None:
        self.path = path
        self._listener = listener
        self._pair = pair
        self._name = name
        self._state: SideState | None = None
        self._trouble = "not connected yet"
        self._is_over = False
        """True if the displayed run has stopped sending."""
        self._row: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._reader: TelemetryReader | None = None
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"console-{name}", daemon=True)

    def start(self) -> None:
        """Start to read."""
        self._thread.start()

    def close(self) -> None:
        """Stop; the loop is not affected."""
        self._closed.set()
        reader = self._reader
        if reader is not None:
            reader.close()
        self._thread.join(CLOSE_S)

    @property
    def side(self) -> str:
        """`master` or `slave`."""
        state = self._state
        return self._name if state is None else state.side

    @property
    def id(self) -> str:
        """Identifier of the side on a page."""
        return side_id(self._pair, self.side)

    def summary(self) -> dict[str, Any]:
        """Return the content of the page beside the charts."""
        with self._lock:
            try:
                return {"id": self.id, **summary(self._state, self._trouble, str(self.path))}
            except Exception as error:  # an error of one side must not affect the other
                return {"id": self.id} | summary(
                    None, f"cannot be shown: {type(error).__name__}: {error}", str(self.path)
                )

    def take_row(self) -> dict[str, Any]:
        """Return and clear the value furthest from zero of each charted signal, in SI units."""
        with self._lock:
            row, self._row = self._row, {}
        return row

    def _run(self) -> None:
        while not self._closed.is_set():
            try:
                with TelemetryReader(self.path) as reader:
                    self._reader = reader
                    self._read(reader)
            except Exception as error:  # if the thread ended, the last sample would remain displayed
                nobody = isinstance(error, FileNotFoundError | ConnectionRefusedError)
                with self._lock:
                    # The end of the last run is more informative than the missing sender.
                    if not (nobody and self._is_over):
                        self._trouble = "nobody sends there" if nobody else str(error) or type(error).__name__
                        self._is_over = self._state is not None
            self._closed.wait(RETRY_S)

    def _read(self, reader: TelemetryReader) -> None:
        state = SideState(reader.hello)
        self._listener(reader.hello)
        with self._lock:
            self._state, self._trouble, self._row, self._is_over = state, "", {}, False
        for message in reader:
            self._listener(reader.hello, message)
            with self._lock:
                state.take(message)
                if isinstance(message, TelemetrySample):
                    self._add(state, message)
            if isinstance(message, TelemetryEnd):
                break
        with self._lock:
            self._is_over = True
            self._trouble = (
                "the run has ended" if state.has_ended else "ended without a word: the side has failed or was killed"
            )

    def _add(self, state: SideState, sample: TelemetrySample) -> None:
        row = self._row
        for name in PLACES:
            if name in sample.signals:
                row[name] = [axis[2] for axis in sample.signals[name]]
        for name in VECTORS:
            if name in sample.signals:
                now = [_furthest(axis[0], axis[1]) for axis in sample.signals[name]]
                row[name] = [_furthest(*pair) for pair in zip(row.get(name, now), now, strict=True)]
        for one in state.observers():
            signal = state.signal_of(one.controller)
            if one.threshold and signal in sample.signals:
                low, high, _ = sample.signals[signal]
                value = high if one.trips_above else low
                if value is not None:
                    share = value / one.threshold
                    row[one.controller] = max(share, row.get(one.controller, share))


def _furthest(low: float | None, high: float | None) -> float | None:
    """Return the value further from zero, so that a spike of one tick is visible."""
    if low is None or high is None:
        return high if low is None else low
    return low if -low > high else high
