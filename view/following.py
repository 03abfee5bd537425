"""Reader of live telemetry of one or both sides, for drawing in another thread."""

import time
from collections.abc import Sequence
from pathlib import Path
from queue import Empty, Full, Queue
from threading import Event, Thread
from types import TracebackType
from typing import Any, Self

from haptether.bridge import TelemetryMessage, TelemetryReader
from haptether.view.scene3d.live import LiveDescription

WAITING = 512
"""Capacity of the message queue; a full queue shows up as lost ticks of this reader."""
STEP_S = 0.005
QUIT_S = 0.2


class Following:
    """A `LiveDescription` fed by sockets; read-only, so that the loops are not affected.

    Args:
        readers: Readers of one side or both.
        live: Arguments of `LiveDescription`: title, arm, leader, history_s.

    Raises:
        ValueError: Two readers are of the same side, or there is no such arm.
    """

    def __init__(self, readers: Sequence[tuple[Path, TelemetryReader]], **live: Any) -> None:  # noqa: ANN401
        self.live = LiveDescription(*(reader.hello for _, reader in readers), **live)
        self.is_over = False
        """True once no more messages come."""
        self._readers = tuple(readers)
        self._messages: Queue[tuple[str, TelemetryMessage | None, float]] = Queue(WAITING)
        self._errors: dict[str, Exception] = {}
        self._open = {reader.hello.side for _, reader in readers}
        self._is_closed = Event()
        self._threads = [Thread(target=self._read, args=(reader,), daemon=True) for _, reader in readers]
        for thread in self._threads:
            thread.start()

    def take(self) -> None:
        """Process all queued messages."""
        while True:
            try:
                side, message, received_s = self._messages.get_nowait()
            except Empty:
                return
            if message is None:
                self._open.discard(side)
                self.is_over = not self._open
            else:
                self.live.take(message, side, received_s=received_s)

    def until(self, time_s: float) -> None:
        """Follow the run until `time_s` in s, or until it is over."""
        while self.live.time_s < time_s and not self.is_over:
            time.sleep(STEP_S)
            self.take()

    def begin(self) -> float:
        """Follow until each side has sent a sample, or the run is over; return its time in s."""
        while not self.live.has_begun and not self.is_over:
            time.sleep(STEP_S)
            self.take()
        return self.live.time_s

    def check(self) -> None:
        """Check that the run ended in good order.

        Raises:
            ConnectionError: A side has failed or was killed.
            Exception: The telemetry is invalid.
        """
        for path, reader in self._readers:
            side = reader.hello.side
            if side in self._errors:
                raise self._errors[side]
            if side not in self._open and not self.live.ended(side):
                message = (
                    f"{path}: ended after {self.live.time_s:.3f} s without a word: the side has failed or was killed"
                )
                raise ConnectionError(message)

    def close(self) -> None:
        """Stop reading."""
        self._is_closed.set()
        for _, reader in self._readers:
            reader.close()
        for thread in self._threads:
            thread.join(QUIT_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read(self, reader: TelemetryReader) -> None:
        side = reader.hello.side
        try:
            for message in reader:
                self._put(side, message)
                if self._is_closed.is_set():
                    return
        except (OSError, ValueError) as error:
            if not self._is_closed.is_set():
                self._errors[side] = error
        self._put(side, None)

    def _put(self, side: str, message: TelemetryMessage | None) -> None:
        while not self._is_closed.is_set():
            try:
                self._messages.put((side, message, time.monotonic()), timeout=QUIT_S)
            except Full:
                continue
            return
