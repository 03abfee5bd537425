"""Search for the answering servos of a silent bus."""

from haptether._core import DynamixelBus
from haptether.dynamixel.arm.faults import ArmFaultError, FaultKind


class RollCall:
    """Ask one servo at a time, so that no read of an arm waits for all silent servos.

    Args:
        lost: Fault before the search.
        members: Servo ids.
    """

    def __init__(self, lost: ArmFaultError, members: bytes) -> None:
        self.lost = lost
        self._members = members
        self._asked = 0
        self._missing: list[int] = []

    @property
    def is_over(self) -> bool:
        """True after all servos were asked."""
        return self._asked >= len(self._members)

    def ask(self, bus: DynamixelBus) -> ArmFaultError | None:
        """Ask the next servo; return a more specific fault once it is known, or None."""
        servo_id = self._members[self._asked]
        self._asked += 1
        try:
            bus.ping(servo_id)
        except TimeoutError:
            self._missing.append(servo_id)
        except OSError as gone:
            self._asked = len(self._members)
            return ArmFaultError(FaultKind.UNPLUGGED, f"{gone}: plug the adapter in, then acknowledge")
        except RuntimeError as garbled:
            self._asked = len(self._members)
            return ArmFaultError(FaultKind.UNREADABLE, f"{garbled}: see cables and rate, then acknowledge")
        if not self.is_over or not self._missing:
            return None
        if len(self._missing) == len(self._members):
            text = "no servo answers any more: see the supply and the cable, then acknowledge"
            return ArmFaultError(FaultKind.BROWN_OUT, text)
        names = ", ".join(map(str, self._missing))
        return ArmFaultError(FaultKind.SILENT, f"of servo {names}: see its cable, then acknowledge")
