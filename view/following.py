"""Reads the telemetry of one side or both, as it comes, for who draws it in another thread."""

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
"""Messages that wait to be drawn; where there are more, the run counts what is lost to this reader."""
STEP_S = 0.005
QUIT_S = 0.2


class Following:
    """A `LiveDescription` that is fed by sockets; it only reads, and the loops do not notice.

    Args:
        readers: Of one side, or of both.
        live: As for `LiveDescription`: title, arm, leader, history_s.

    Raises:
        ValueError: Two of the same side, or no such arm.
    """

    def __init__(self, readers: Sequence[tuple[Path, TelemetryReader]], **live: Any) -> None:  # noqa: ANN401
        self.live = LiveDescription(*(reader.hello for _, reader in readers), **live)
        self.is_over = False
        """Whether nothing more comes."""
        self._readers = tuple(readers)
        self._messages: Queue[tuple[str, TelemetryMessage | None, float]] = Queue(WAITING)
        self._errors: dict[str, Exception] = {}
        self._open = {reader.hello.side for _, reader in readers}
        self._is_closed = Event()
        self._threads = [Thread(target=self._read, args=(reader,), daemon=True) for _, reader in readers]
        for thread in self._threads:
            thread.start()

    def take(self) -> None:
        """Takes all that has come."""
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
        """Follows until the run has come to a time in s, or is over."""
        while self.live.time_s < time_s and not self.is_over:
            time.sleep(STEP_S)
            self.take()

    def begin(self) -> float:
        """Follows until there is a first sample of each side, or the run is over; returns its time in s."""
        while not self.live.has_begun and not self.is_over:
            time.sleep(STEP_S)
            self.take()
        return self.live.time_s

    def check(self) -> None:
        """Says that the run did not end in good order.

        Raises:
            ConnectionError: A side has failed or was killed.
            Exception: What was sent is no telemetry.
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
        """Reads no more."""
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
