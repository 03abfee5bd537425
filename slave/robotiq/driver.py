"""Driver of a Robotiq gripper on the URCap of a UR arm: `robotiq`."""

import sys
import threading
import time
from dataclasses import replace
from typing import Any, Final

from haptether.checklist import Checklist, RefusedError
from haptether.printed import printed
from haptether.slave.gripper import GripperCommand, GripperSample
from haptether.slave.robotiq.checks import check_address, check_gripper, choose, look
from haptether.slave.robotiq.options import RobotiqOptions, robotiq_options
from haptether.slave.robotiq.session import Order, Session
from haptether.slave.robotiq.wire import CONNECT_S, Wire, WireError

IDLE_S: Final = 0.5
"""Longest wait of the thread in s without a check for the end."""


class RobotiqGripper:
    """Robotiq gripper; see `Gripper` and docs/gripper.md. A separate thread talks to the server.

    Args:
        options: Fields of `RobotiqOptions`.

    Raises:
        ValueError: The options are invalid. `open` also raises `RefusedError` if it is not ready, `WireError` if it is
            silent.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: RobotiqOptions = robotiq_options(options)
        self._name = f"robotiq {self.options.host}"
        self._address = ""
        self._wire: Wire | None = None
        self._session: Session
        self._thread: threading.Thread | None = None
        self._ending = threading.Event()
        self._wake = threading.Event()
        self._acknowledged = False
        # Each of the following is written by one thread and read by the other, by single assignments of immutable
        # values.
        self._order: Order | None = None
        self._orders = 0
        self._sample: GripperSample
        self._looked_s = 0.0
        """Time of the thread's last cycle."""
        self._stalled: str | None = None
        """Fault of a stalled thread, latched by the reading thread."""
        self._shown: str | None = None
        """Fault of the last sample."""

    # -------------------------------------------------------------------------------------------------- Gripper

    def open(self) -> None:
        """Run the checklist and connect; the jaws move only if `activate` allows it."""
        options, checklist = self.options, Checklist(self._name)
        self._address = check_address(options.host, checklist)
        self._wire = Wire(self._address, options.port, options.reply_timeout_s)
        try:
            self._pause_opening(0.0)
            values = check_gripper(
                self._wire, options, checklist, ask=lambda _: options.activate, pause=self._pause_opening
            )
        except Exception:
            self._wire.close()
            raise
        self._begin(values)
        self._thread = threading.Thread(target=self._run, name="robotiq", daemon=True)
        self._thread.start()

    def read(self) -> GripperSample:
        """Return the latest sample."""
        sample = self._sample
        age_s = time.monotonic() - self._looked_s
        if sample.fault is None and self._stalled is None and age_s > self._longest_s:
            self._stalled = f"silence: its thread has stood still for {age_s:.1f} s: see what else this machine does"
            self._give(None)
        if sample.fault is None and self._stalled is not None:
            sample = replace(sample, velocity=0.0, fault=self._stalled)
        self._shown = sample.fault
        return sample

    def write(self, command: GripperCommand) -> None:
        """Command the jaws; no effect during a fault."""
        if self._sample.fault is None and self._stalled is None:
            self._give(command)

    def hold(self) -> None:
        """Stop the jaws, unless they press on an object; then they keep their force."""
        self._give(None)

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault: reconnect if needed, without motion."""
        fault = self._sample.fault or self._stalled
        if fault is None or fault is not self._shown:
            # A fault since the last sample has not been shown yet.
            return
        self._stalled = None
        if self._sample.fault is not None:
            self._acknowledged = True
            self._wake.set()

    def close(self) -> None:
        """Hold and disconnect, within the timeouts of one reply and one connection."""
        self._ending.set()
        self._wake.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(2.0 * self.options.reply_timeout_s + CONNECT_S)
        if self._wire is not None:
            self._wire.close()
        if thread is not None:
            thread.join(self.options.reply_timeout_s)

    # --------------------------------------------------------------------------------------------------- thread

    @property
    def round_trip_s(self) -> float:
        """Average time in s from a request to its reply."""
        return self._session.round_trip_s

    @property
    def _longest_s(self) -> float:
        """Longest cycle of the thread in s without a fault."""
        return IDLE_S + 2.0 * self.options.reply_timeout_s

    def _give(self, move: GripperCommand | None) -> None:
        self._orders += 1
        self._order = Order(self._orders, move)
        self._wake.set()

    def _begin(self, values: dict[str, int]) -> None:
        now_ns = time.monotonic_ns()
        self._session = Session(self.options.scale, self.options.rate_hz, values, self._order, now_ns)
        self._looked_s = time.monotonic()
        self._sample = self._session.sample(now_ns)

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                self._step()
            self._leave()
        except Exception as error:  # if the thread ended with a traceback, the last sample would persist
            self._lose(f"its driver failed: {type(error).__name__}: {error}")
        finally:
            if self._wire is not None:
                self._wire.close()

    def _step(self) -> None:
        """Perform one exchange, or a wait."""
        self._looked_s = time.monotonic()
        if self._acknowledged:
            self._acknowledged = False
            self._recover()
        if self._wire is None:
            self._wake.wait(IDLE_S)
            self._wake.clear()
            return
        self._wake.clear()
        order, now_ns = self._order, time.monotonic_ns()
        request = self._session.due(order, now_ns)
        if request is None:
            self._wake.wait(min(IDLE_S, 1e-9 * self._session.wait_ns(order, now_ns)))
            return
        try:
            value = self._wire.exchange(request)
        except WireError as error:
            self._lose(str(error))
            return
        sent_ns, now_ns = now_ns, time.monotonic_ns()
        self._session.replied(request, value, sent_ns, now_ns)
        self._show(self._session.sample(now_ns))

    def _recover(self) -> None:
        if self._wire is not None:
            self._session.acknowledge()
            self._show(self._session.sample(time.monotonic_ns()))
            return
        try:
            wire = Wire(self._address, self.options.port, self.options.reply_timeout_s)
        except WireError as error:
            self._lose(str(error))
            return
        try:
            choose(wire, self.options)
            values = look(wire)
        except (WireError, RefusedError) as error:
            wire.close()
            self._lose(str(error))
            return
        self._wire = wire
        self._begin(values)
        self._report("ready")

    def _leave(self) -> None:
        """Perform the last exchange: stop moving jaws, leave pressing jaws unchanged."""
        if self._wire is None:
            return
        request = self._session.due(Order(self._orders + 1, None), time.monotonic_ns())
        if request is not None and request.reads is None:
            try:
                self._wire.exchange(request)
            except WireError as error:
                self._report(f"at the end: {error}")

    def _lose(self, fault: str) -> None:
        """Stop sending; the gripper keeps its grip, and finishes its current motion."""
        if self._wire is not None:
            self._wire.close()
        self._wire = None
        self._show(replace(self._sample, velocity=0.0, fault=fault))

    def _show(self, sample: GripperSample) -> None:
        before, self._sample = self._sample.fault, sample
        if sample.fault is not None and sample.fault != before:
            self._report(f"fault: {printed(sample.fault)}")

    def _pause_opening(self, seconds: float) -> None:
        if self._ending.wait(seconds):
            message = "closed before it was open"
            raise WireError(message)

    def _report(self, text: str) -> None:
        print(f"{self._name}: {text}", file=sys.stderr, flush=True)
