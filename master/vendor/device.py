"""A device behind a vendor's library: latched faults, no force without a fresh sample, and the way back."""

import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

from haptether.checklist import Checklist, RefusedError
from haptether.master.device import MasterSample
from haptether.master.frame import REST

Session = TypeVar("Session")
JOIN_S: Final = 3.0
HALTS: Final = 20
"""So often a device that does not answer is told to end its force."""


class LostError(Exception):
    """The device does not answer any more: it has to be opened anew."""


class BadSampleError(Exception):
    """There is no sample that can be trusted."""


class VendorDevice(ABC, Generic[Session]):
    """The part of a driver that does not depend on the vendor; see `MasterDevice`.

    A fault ends the force at once and is latched, until the operator acknowledges it. After a lost connection two acts
    are needed: to open the device anew, on a thread of its own, and to go on.

    Args:
        name: At the begin of each line that is printed.
        axes: Of the samples.
        turns: Whether samples have an orientation.
    """

    paces = False
    period_s: float | None = None

    def __init__(self, name: str, axes: int, *, turns: bool) -> None:
        self.name = name
        self.axes = axes
        self._turns = turns
        self._session: Session | None = None
        self._lost: Session | None = None
        """One that does not answer any more and has to be released yet."""
        self._halts = 0
        self._sample: MasterSample | None = None
        self._fresh = False
        """Whether the newest sample is of this tick and nothing is wrong: only then a force is exerted."""
        self._fault: str | None = None
        """Latched."""
        self._shown: str | None = None
        """The fault of the last sample."""
        self._reopened: Session | str | None = None
        """What the thread that opens it anew has found: a session, or why there is none."""
        self._reopening: threading.Thread | None = None
        self._ending = threading.Event()
        self._taking = threading.Lock()
        """Held for a moment by whoever takes a session that another thread may take, too."""

    # ------------------------------------------------------------------------------------------- of the vendor

    @abstractmethod
    def _connect(self, checklist: Checklist) -> Session:
        """Opens the device, without a force; what was opened by an attempt that fails is closed by it.

        Raises:
            RefusedError: It is not there or not ready.
        """

    @abstractmethod
    def _measure(self, session: Session) -> MasterSample:
        """A new sample.

        Raises:
            LostError: The connection is lost.
            BadSampleError: There is none that can be trusted, or something is wrong with the device.
        """

    @abstractmethod
    def _exert(self, session: Session, force: Sequence[float], torque: Sequence[float]) -> None:
        """Exerts both until the next call, bounded, in our frame.

        Raises:
            LostError: The connection is lost.
            BadSampleError: The device does not take it.
        """

    @abstractmethod
    def _halt(self, session: Session) -> None:
        """Ends all force, now and until the next `_exert`; does not raise. Called again, it tries what has failed."""

    @abstractmethod
    def _release(self, session: Session) -> None:
        """Ends all force and closes the device, whatever it is in; does not raise."""

    def _clear(self, session: Session) -> None:
        """The operator has acknowledged a fault."""

    # -------------------------------------------------------------------------------------------- MasterDevice

    def open(self) -> None:
        """Goes through the checklist and opens the device; no force."""
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
            # By another thread, which may have found nothing to close.
            session, self._session = self._session, None
            if session is not None:
                self._release(session)
            message = "closed before it was open"
            raise RefusedError(message)

    def read(self) -> MasterSample:
        """The newest sample; the last one and a fault where there is none."""
        sample = self._read()
        self._shown = sample.fault
        return sample

    def write(self, force: tuple[float, ...], torque: tuple[float, ...] | None = None) -> None:
        """Exerts the force; all of it ends where this tick was not read, and nothing is exerted with a fault."""
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
        """The operator has removed the fault; a device that was lost is opened anew."""
        if self._fault is not self._shown or self._reopening is not None:
            # One since the last sample was not shown to anybody; what is under way ends by itself.
            return
        self._fault = None
        if self._session is not None:
            self._clear(self._session)
        else:
            self._fault = "opening it anew: acknowledge again once it is"
            self._reopening = threading.Thread(target=self._reopen, name=self.name, daemon=True)
            self._reopening.start()

    def close(self) -> None:
        """Ends all force and closes the device."""
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
            # Another thread takes it to release it.
            lost = self._lost
            if lost is not None and self._halts < HALTS:
                # It may be back by now, and exert what it was sent last.
                self._halts += 1
                self._halt(lost)
            if self.paces:
                # Nobody else waits.
                time.sleep(self.period_s or 1e-3)
            return self._faulty()
        if self._fault is not None:
            # The first time may have failed, and nothing is written while there is a fault.
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
            print(f"{self.name}: fault: {fault}", file=sys.stderr, flush=True)

    def _lose(self, fault: str) -> None:
        self._latch(f"{fault}: acknowledge to open it anew", anew=True)
        # Closing it may take its time.
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
        except Exception as error:  # whatever it is: the operator has to learn of it
            self._reopened = f"not ready: {error}"
        if self._ending.is_set():
            # `close` waits for a while only.
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
