"""Device behind a vendor's library: latched faults, no force without a fresh sample, recovery."""

import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

from haptether.checklist import Checklist, RefusedError
from haptether.master.device import MasterSample
from haptether.master.frame import REST
from haptether.printed import printed

Session = TypeVar("Session")
JOIN_S: Final = 3.0
HALTS: Final = 20
"""Number of attempts to end the force of a silent device."""


class LostError(Exception):
    """The device no longer answers and must be reopened."""


class BadSampleError(Exception):
    """No trustworthy sample is available."""


class VendorDevice(ABC, Generic[Session]):
    """Vendor-independent part of a driver; see `MasterDevice`.

    A fault ends the force at once and is latched until the operator acknowledges it. After a lost connection two
    acknowledgements are needed: one reopens the device on a separate thread, one continues.

    Args:
        name: Prefix of each printed line.
        axes: Number of axes in samples.
        turns: True if samples have an orientation.
    """

    paces = False
    period_s: float | None = None

    def __init__(self, name: str, axes: int, *, turns: bool) -> None:
        self.name = name
        self.axes = axes
        self._turns = turns
        self._session: Session | None = None
        self._lost: Session | None = None
        """Session that no longer answers and must still be released."""
        self._halts = 0
        self._sample: MasterSample | None = None
        self._fresh = False
        """True if the latest sample is of this tick without a fault; required for a force."""
        self._fault: str | None = None
        """Latched fault."""
        self._shown: str | None = None
        """Fault of the last sample."""
        self._reopened: Session | str | None = None
        """Result of the reopening thread: a session, or the reason of failure."""
        self._reopening: threading.Thread | None = None
        self._ending = threading.Event()
        self._taking = threading.Lock()
        """Held briefly by a thread that takes a session, because another may take it too."""

    # ------------------------------------------------------------------------------------------- of the vendor

    @abstractmethod
    def _connect(self, checklist: Checklist) -> Session:
        """Open the device without force; a failed attempt closes what it opened.

        Raises:
            RefusedError: The device is not available or not ready.
        """

    @abstractmethod
    def _measure(self, session: Session) -> MasterSample:
        """Return a new sample.

        Raises:
            LostError: The connection is lost.
            BadSampleError: No trustworthy sample, or a device fault.
        """

    @abstractmethod
    def _exert(self, session: Session, force: Sequence[float], torque: Sequence[float]) -> None:
        """Exert force and torque until the next call, bounded, in the scene frame.

        Raises:
            LostError: The connection is lost.
            BadSampleError: The device refuses the force.
        """

    @abstractmethod
    def _halt(self, session: Session) -> None:
        """End all force until the next `_exert`; never raises. A repeated call retries failed steps."""

    @abstractmethod
    def _release(self, session: Session) -> None:
        """End all force and close the device in any state; never raises."""

    def _clear(self, session: Session) -> None:
        """Handle the operator's acknowledgement of a fault."""

    # -------------------------------------------------------------------------------------------- MasterDevice

    def open(self) -> None:
        """Run the checklist and open the device, without force."""
        if self._session is not None:
            message = f"{self.name}: is open"
            raise ValueError(message)
        if self._reopening is not None and self._reopening.is_alive():
            message = f"{self.name}: it is still opened anew from before: open it once that has ended"
            raise RuntimeError(message)
        self._ending.clear()
        self._sample, self._fault, self._shown, self._fresh = None, None, None, False
        self._reopened = self._reopening = None
        self._session = self._connect(Checklist(self.name))
        if self._ending.is_set():
            # Closed by another thread, which may have found nothing to close.
            session, self._session = self._session, None
            if session is not None:
                self._release(session)
            message = "closed before it was open"
            raise RefusedError(message)

    def read(self) -> MasterSample:
        """Return the latest sample; without one, the last sample and a fault."""
        sample = self._read()
        self._shown = sample.fault
        return sample

    def write(self, force: tuple[float, ...], torque: tuple[float, ...] | None = None) -> None:
        """Exert the force; end all force if this tick was not read, and exert none during a fault."""
        fresh, self._fresh = self._fresh, False
        session = self._session
        if session is None or self._fault is not None:
            return
        if not fresh:
            self._halt(session)
            return
        try:
            self._exert(session, force, torque or REST)
        except LostError as error:
            self._lose(str(error))
        except BadSampleError as error:
            self._latch(str(error))

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault; a lost device is reopened."""
        if self._fault is not self._shown or self._reopening is not None:
            # A fault since the last sample has not been shown yet; a running reopening ends by itself.
            return
        self._fault = None
        if self._session is not None:
            self._clear(self._session)
        else:
            self._fault = "opening it anew: acknowledge again once it is"
            self._reopening = threading.Thread(target=self._reopen, name=self.name, daemon=True)
            self._reopening.start()

    def close(self) -> None:
        """End all force and close the device."""
        self._ending.set()
        session, self._session = self._session, None
        if session is not None:
            self._release(session)
        if self._reopening is not None:
            self._reopening.join(JOIN_S)
        self._release_reopened()
        lost = self._take_lost()
        if lost is not None:
            self._release(lost)

    # ------------------------------------------------------------------------------------------------- faults

    def _read(self) -> MasterSample:
        self._fresh = False
        self._take_reopened()
        session = self._session
        if session is None:
            # Another thread may take it for release.
            lost = self._lost
            if lost is not None and self._halts < HALTS:
                # It may have returned, and exert its last force.
                self._halts += 1
                self._halt(lost)
            if self.paces:
                # No other code waits.
                time.sleep(self.period_s or 1e-3)
            return self._faulty()
        if self._fault is not None:
            # The first halt may have failed, and nothing is written during a fault.
            self._halt(session)
        try:
            sample = self._measure(session)
        except LostError as error:
            self._lose(str(error))
            return self._faulty()
        except BadSampleError as error:
            self._latch(str(error))
            return self._faulty()
        self._fresh = self._fault is None
        self._sample = sample._replace(fault=self._fault)
        return self._sample

    def _latch(self, fault: str, *, anew: bool = False) -> None:
        self._fresh = False
        if self._session is not None:
            self._halt(self._session)
        if self._fault is None or anew:
            self._fault = fault
            print(f"{self.name}: fault: {printed(fault)}", file=sys.stderr, flush=True)

    def _lose(self, fault: str) -> None:
        self._latch(f"{fault}: acknowledge to open it anew", anew=True)
        # Closing may take time.
        self._lost, self._session, self._halts = self._session, None, 0

    def _take_lost(self) -> Session | None:
        with self._taking:
            session, self._lost = self._lost, None
        return session

    def _reopen(self) -> None:
        lost = self._take_lost()
        if lost is not None:
            self._release(lost)
        try:
            self._reopened = self._connect(Checklist(self.name))
        except Exception as error:  # whatever the error, the operator must see it
            self._reopened = f"not ready: {error}"
        if self._ending.is_set():
            # `close` has a timeout.
            self._release_reopened()

    def _release_reopened(self) -> None:
        with self._taking:
            left, self._reopened = self._reopened, None
        if left is not None and not isinstance(left, str):
            self._release(left)

    def _take_reopened(self) -> None:
        with self._taking:
            reopened, self._reopened = self._reopened, None
        if reopened is None:
            return
        self._reopening = None
        if isinstance(reopened, str):
            self._latch(f"{reopened}: acknowledge to open it anew", anew=True)
            return
        self._session = reopened
        self._fault = "opened anew: acknowledge to go on"

    def _faulty(self) -> MasterSample:
        fault = self._fault or "not open: acknowledge to open it"
        if self._sample is None:
            unturned = (1.0, 0.0, 0.0, 0.0) if self._turns else None
            return MasterSample(REST[: self.axes], None, None, fault, None, unturned)
        velocity = None if self._sample.velocity is None else REST[: self.axes]
        return self._sample._replace(velocity=velocity, fault=fault, buttons=None)
