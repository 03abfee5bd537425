"""Driver of a Haply Inverse3: `inverse3`."""

import contextlib
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from haptether.checklist import Checklist, RefusedError
from haptether.master.device import MasterSample
from haptether.master.frame import REST, clipped
from haptether.master.inverse3.channel import Channel, ChannelError
from haptether.master.inverse3.checks import (
    EBRAKE,
    brake,
    check_events,
    chosen_device,
    chosen_grip,
    event_fault,
    first_frame,
    grip_fault,
    opened_events,
    pending_events,
    status_fault,
)
from haptether.master.inverse3.messages import GRIPS, ForceMessage, InverseDevice, MessageError, configuration, reply
from haptether.master.inverse3.options import Inverse3Options, inverse3_options
from haptether.printed import printed

ADDED_N: Final = 0.3
ADDED_SHARE: Final = 0.1
"""Tolerance of the reported force over the sent force, in N and as a fraction."""
ADDED_REPLIES: Final = 20
"""Number of consecutive replies above it that is a fault; reports may lag by some ticks."""
CLOSED: Final = "closed before it was open"
JOIN_S: Final = 3.0
LOST_S: Final = 0.05
"""Timeout in s after which a reply is lost."""
MAX_LATE: Final = 10
LATE_S: Final = 1.0
"""Limit of late replies within that time in s: a tenth of the time with the default timeout."""
SLEW_N_PER_S: Final = 1000.0
"""Growth limit of the force norm after a zero by the driver; default of the safety limiter."""
TICK_S: Final = 0.001
"""Longest pause between two forces that counts for the growth, in s."""
ZERO_S: Final = 0.1
"""Timeout in s of each reply before the end."""
CLOSE_S: Final = 1.0
"""Timeout in s of the service's close."""
MAX_UNASKED: Final = 20
"""Frames dropped per tick; a flood must not delay it."""
UNASKED_S: Final = 0.005
"""Time in s for dropping frames per tick."""


class Session(NamedTuple):
    """Two connections and the devices behind them."""

    channel: Channel
    events: Channel
    device_id: str
    grip_id: str | None
    force: ForceMessage

    def rest(self) -> None:
        """Send a zero force, whatever was received."""
        self.channel.send_last(self.force(REST))

    def close(self, owed: int = 0) -> None:
        """Wait for the owed replies, the last to the zero force, and close both; the service then idles the device."""
        with contextlib.suppress(ChannelError):
            # A close in the same packet could make the service lose the zero force.
            while owed > 0 and self.channel.frame(ZERO_S) is not None:
                owed -= 1
        self.channel.close(CLOSE_S)
        self.events.close()


class Inverse3:
    """Haply Inverse3, with a VerseGrip as pose; see `MasterDevice` and docs/haptic_devices.md.

    A tick is one message: `write` sends the force, and the next `read` takes its reply, whose state is one period old.
    If the reply is late, a zero force is sent and `read` waits. The norm of the force then grows from zero by at most
    `SLEW_N_PER_S` until it has caught up. A lost reply ends the connection, so that replies cannot be confused.

    Args:
        options: Fields of `Inverse3Options`.

    Raises:
        ValueError: The options are invalid. `open` also raises `RefusedError` if the device is not ready.
    """

    paces = False
    exerts_by_itself = True
    """The vendor's service may add gravity compensation to each force, which is known only once it is open."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: Inverse3Options = inverse3_options(options)
        self.axes = len(self.options.axes)
        self._frame = self.options.frame
        self._name = f"inverse3 {self.options.host}"
        grips = self.options.grip != "none" and len(self.options.axes) == 3
        self.kinds: tuple[str, ...] = ("linear", "pose") if grips else ("linear",)
        self._session: Session | None = None
        self._owed = 0
        """Number of outstanding replies."""
        self._late_s: deque[float] = deque(maxlen=MAX_LATE)
        """Times of the last late replies."""
        self.late_replies = 0
        """Number of replies that were late."""
        self._sample: MasterSample | None = None
        self._fresh = False
        """True if the latest sample is of this tick without a fault; required for sending a force."""
        self._fault: str | None = None
        """Latched fault."""
        self._shown: str | None = None
        """Fault of the last sample."""
        self._braked = False
        self._sent: list[float] = [0.0, 0.0, 0.0]
        """Norms of the last sent forces in N."""
        self._bound_n: float | None = 0.0
        """Bound of the norm in N while the force grows after a zero by the driver; None otherwise."""
        self._bound_s = 0.0
        self._added = 0
        self._forced: str | None = None
        """Device of a lost connection; the arrival of the last zero force is unknown."""
        self._closing: threading.Thread | None = None
        """Thread that closes a lost connection."""
        self._mended: Session | str | None = None
        """Result of the reconnecting thread: a session, or the reason of failure."""
        self._mending: threading.Thread | None = None
        self._ending = threading.Event()

    # -------------------------------------------------------------------------------------------- MasterDevice

    def open(self) -> None:
        """Run the checklist and connect, without force."""
        if self._session is not None:
            message = f"{self._name}: is open"
            raise ValueError(message)
        if self._mending is not None and self._mending.is_alive():
            message = f"{self._name}: it still connects from before: open it once that has ended"
            raise RuntimeError(message)
        self._ending.clear()
        self._sample, self._fault, self._shown, self._fresh = None, None, None, False
        self._sent, self._added, self._mended, self._mending = [0.0, 0.0, 0.0], 0, None, None
        session = self._connected(Checklist(self._name))
        self._session, self._owed, self.late_replies = session, 0, 0
        self._late_s.clear()
        if self._ending.is_set():
            self._session = None
            session.close()
            raise RefusedError(CLOSED)

    def read(self) -> MasterSample:
        """Return the reply to the last message; without one, the last position and a fault."""
        sample = self._read()
        self._shown = sample.fault
        return sample

    def _read(self) -> MasterSample:
        self._fresh = False
        self._look_at_mending()
        session = self._session
        if session is None:
            return self._faulty()
        try:
            for happened in pending_events(session.events):
                braked = brake(happened, session.device_id)
                self._braked = self._braked if braked is None else braked
                self._take_fault(event_fault(happened, session.device_id, session.grip_id))
            if self._owed == 0:
                self._rest(session)
            device, orientation, buttons = self._reply(session)
        except ChannelError as error:
            self._lose(str(error))
            return self._faulty()
        try:
            position = self._frame.position(device.state.cursor_position.xyz)
            velocity = self._frame.vector(device.state.cursor_velocity.xyz) if self.options.device_velocity else None
            turned = None if orientation is None else self._frame.orientation(orientation)
        except ValueError as error:
            self._lose(f"malformed reply: {error}")
            return self._faulty()
        self._compare(device)
        self._fresh = self._fault is None
        self._sample = MasterSample(position, velocity, None, self._fault, None, turned, None, buttons)
        return self._sample

    def write(self, force: tuple[float, ...], torque: tuple[float, ...] | None = None) -> None:  # noqa: ARG002
        """Send the force, which the service exerts for a tick; zero unless this tick was read without a fault.

        The torque is ignored, because the device cannot exert one.
        """
        session = self._session
        if session is None:
            return
        is_fresh, self._fresh = self._fresh, False
        try:
            self._drop_unasked(session)
            if is_fresh:
                wanted = clipped(self._frame.to_device(force), self.options.max_force_n)
                self._send(session, self._slewed(wanted))
            else:
                self._rest(session)
        except ChannelError as error:
            self._lose(str(error))

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault; a lost connection is reopened on a separate thread."""
        if self._fault is not self._shown:
            # A fault since the last sample has not been shown yet.
            return
        self._fault = None
        self._added = 0
        if self._session is None and self._mending is None:
            self._fault = "connecting anew: acknowledge again once it has"
            self._mending = threading.Thread(target=self._mend, name="inverse3", daemon=True)
            self._mending.start()

    def close(self) -> None:
        """Send a zero force and disconnect."""
        self._ending.set()
        session, self._session = self._session, None
        if session is not None:
            session.rest()
            session.close(self._owed + 1)
            if self.late_replies:
                print(f"{self._name}: {self.late_replies} replies were late", file=sys.stderr, flush=True)
        for thread in (self._closing, self._mending):
            if thread is not None:
                thread.join(JOIN_S)
        mended, self._mended = self._mended, None
        if isinstance(mended, Session):
            mended.close()

    # ----------------------------------------------------------------------------------------------- connection

    def _connected(self, checklist: Checklist) -> Session:
        options = self.options
        try:
            channel = Channel(options.host, options.port)
        except ChannelError as error:
            checklist.refuse("service", str(error), "is the Inverse Service running there, of version 3.5 or later?")
            checklist.finish()
            raise
        events = None
        try:
            try:
                found = first_frame(channel)
            except ChannelError as error:
                checklist.refuse("service", str(error), "is another program on this port?")
                checklist.finish()
                raise
            checklist.ok("service", f"port {options.port}")
            if (forced := self._forced) is not None:
                # Send zero before any refusal.
                channel.send(ForceMessage(forced, None)(REST))
                channel.frame(options.reply_timeout_s)
                self._forced = None
            device = chosen_device(found, options, checklist)
            grip = chosen_grip(found, options, checklist)
            events = opened_events(options, checklist)
            channel.send(configuration(device.device_id, force_gate=options.force_gate, damping=options.damping))
            if channel.frame(1.0) is None:
                checklist.refuse("reply", "none within 1 s", "does the service answer the vendor's own demos?")
                checklist.finish()
            check_events(events, options, checklist)
            if self._ending.is_set():
                raise RefusedError(CLOSED)
        except BaseException:
            channel.close()
            if events is not None:
                events.close()
            raise
        chosen = None if grip is None else (GRIPS[options.grip], grip.device_id)
        grip_id = None if grip is None else grip.device_id
        return Session(channel, events, device.device_id, grip_id, ForceMessage(device.device_id, chosen))

    def _mend(self) -> None:
        try:
            self._mended = self._connected(Checklist(self._name))
        except Exception as error:  # whatever the error, it must be visible, and a retry is possible
            self._mended = f"not ready: {error}"
            return
        if self._ending.is_set():
            # The closing thread may have timed out.
            mended, self._mended = self._mended, None
            if isinstance(mended, Session):
                mended.close()

    def _look_at_mending(self) -> None:
        mended = self._mended
        if mended is None:
            return
        self._mended = self._mending = None
        if isinstance(mended, str):
            self._latch(mended, anew=True)
            return
        self._session, self._owed = mended, 0
        self._late_s.clear()
        self._fault = "connected anew: acknowledge to go on"

    def _send(self, session: Session, force: Sequence[float]) -> None:
        self._owed += 1
        session.channel.send(session.force(force))
        self._sent = [*self._sent[1:], math.hypot(*force)]

    def _rest(self, session: Session) -> None:
        """Send a zero force; the force then grows from zero."""
        self._bound_n, self._bound_s = 0.0, time.monotonic()
        self._send(session, REST)

    def _slewed(self, force: Sequence[float]) -> Sequence[float]:
        """Shorten the force until it has caught up after a zero by the driver."""
        if self._bound_n is None:
            return force
        now_s = time.monotonic()
        self._bound_n += SLEW_N_PER_S * min(now_s - self._bound_s, TICK_S)
        self._bound_s = now_s
        if math.hypot(*force) > self._bound_n:
            return clipped(force, self._bound_n)
        self._bound_n = None
        return force

    def _reply(self, session: Session) -> tuple[InverseDevice, tuple[float, float, float, float] | None, int | None]:
        """Return the latest reply after all outstanding ones, with orientation and buttons of the grip."""
        received = b""
        is_late = False
        end_s = time.monotonic() + self.options.reply_timeout_s
        while self._owed > 0:
            frame = session.channel.frame(max(0.0, end_s - time.monotonic()))
            if frame is not None:
                received = frame
                self._owed -= 1
            elif is_late:
                message = f"lost reply: none within {LOST_S:g} s: is the service overloaded?"
                raise ChannelError(message)
            else:
                self._note_late(session)
                is_late = True
                end_s += LOST_S - self.options.reply_timeout_s
        try:
            state = reply(received)
        except MessageError as error:
            message = f"malformed reply: {error}"
            raise ChannelError(message) from None
        device = next((found for found in state.inverse3 if found.device_id == session.device_id), None)
        if device is None:
            message = f"device disconnected: the service has no {session.device_id} any more: see its cable"
            raise ChannelError(message)
        self._take_fault(status_fault(device.status))
        if session.grip_id is None:
            return device, None, None
        grips = state.grips(GRIPS[self.options.grip])
        grip = next((found for found in grips if found.device_id == session.grip_id), None)
        if grip is None or grip.state.orientation is None:
            message = f"grip lost: the service has no {session.grip_id} any more: is it charged and in reach?"
            raise ChannelError(message)
        self._take_fault(grip_fault(grip, self.options.grip))
        return device, grip.state.orientation.wxyz, grip.buttons

    def _note_late(self, session: Session) -> None:
        """Handle a late reply: end the force at once, if the service still receives.

        Raises:
            ChannelError: Replies are late too often.
        """
        now_s = time.monotonic()
        self.late_replies += 1
        if len(self._late_s) == MAX_LATE and now_s - self._late_s[0] < LATE_S:
            message = (
                f"late replies: {MAX_LATE + 1} within {LATE_S:g} s took longer than reply_timeout_s ="
                f" {self.options.reply_timeout_s:g}: is the service overloaded?"
            )
            raise ChannelError(message)
        self._late_s.append(now_s)
        self._rest(session)

    def _drop_unasked(self, session: Session) -> None:
        """Drop unrequested frames, which would shift each later reply by one tick."""
        end_s = time.monotonic() + UNASKED_S
        for _ in range(MAX_UNASKED):
            if self._owed != 0 or session.channel.frame(0.0) is None:
                return
            self._latch("unasked frame: does another program use this session? acknowledge")
            if time.monotonic() > end_s:
                break
        message = f"more than {MAX_UNASKED} unasked frames at once"
        raise ChannelError(message)

    # --------------------------------------------------------------------------------------------------- faults

    def _take_fault(self, fault: str | None) -> None:
        if fault is not None:
            self._latch(fault)
        elif self._braked:
            self._latch(
                f"{EBRAKE}: the emergency brake is still on, or was when it was last heard of: release it (where it is"
                " released, press it and release it), acknowledge"
            )

    def _compare(self, device: InverseDevice) -> None:
        """Detect a force above the sent one, because forces of several programs add."""
        said = device.state.current_cursor_force
        if said is None:
            return
        more = math.hypot(*said.xyz) > (1.0 + ADDED_SHARE) * max(self._sent) + ADDED_N
        self._added = self._added + 1 if more else 0
        if self._added >= ADDED_REPLIES:
            self._latch(
                f"force of another: the service exerts {math.hypot(*said.xyz):.2f} N where {max(self._sent):.2f} N were"
                " sent: end other programs, and navigation and effects of the hub, acknowledge"
            )

    def _latch(self, fault: str, *, anew: bool = False) -> None:
        if self._fault is None or anew:
            self._fault = fault
            print(f"{self._name}: fault: {printed(fault)}", file=sys.stderr, flush=True)

    def _lose(self, fault: str) -> None:
        """Send a zero force last; the connection closes on a separate thread."""
        self._fresh = False
        session, self._session = self._session, None
        if session is not None:
            session.rest()
            self._forced = session.device_id
            self._closing = threading.Thread(
                target=session.close, args=(self._owed + 1,), name="inverse3-close", daemon=True
            )
            self._closing.start()
        self._latch(f"{fault}: acknowledge to connect anew", anew=True)

    def _faulty(self) -> MasterSample:
        fault = self._fault or "not connected: acknowledge to connect"
        if self._sample is None:
            unturned = (1.0, 0.0, 0.0, 0.0) if self.options.grip != "none" else None
            return MasterSample((0.0,) * len(self.options.axes), None, None, fault, None, unturned)
        velocity = None if self._sample.velocity is None else (0.0,) * len(self.options.axes)
        return self._sample._replace(velocity=velocity, fault=fault, buttons=None)
