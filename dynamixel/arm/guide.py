"""Calibration dialogue with a person who moves an arm without torque: zero, joint directions and ranges."""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from haptether._core import DynamixelBus, SyncRead
from haptether.dynamixel.arm.arm import Vector
from haptether.dynamixel.arm.checks import answer_all, opened_bus
from haptether.dynamixel.arm.settings import TURN, ServoSettings
from haptether.dynamixel.control_table import CENTRE, HOMING_OFFSET, PRESENT_POSITION, RAD_PER_TICK, TORQUE_ENABLE
from haptether.dynamixel.models import BAUD_RATES, SERVO_MODELS_BY_NUMBER, OperatingMode, ServoModel

STILL_RAD: Final = 0.01
"""Largest joint motion in rad between two reads while a pose is taken."""
TURNED_RAD: Final = 0.2
"""Turn in rad that shows the direction of a joint."""
BESIDE_RAD: Final = 0.1
"""Largest motion in rad of the other joints meanwhile."""
SHOWN_S: Final = 0.2
"""Interval in s of displayed angles."""
READ_S: Final = 0.01
QUARTER: Final = 0.5 * math.pi


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundServo:
    """Servo that answers."""

    baud: int
    servo_id: int
    number: int
    firmware: int

    @property
    def model(self) -> ServoModel | None:
        """Model, or None for an unknown number."""
        return SERVO_MODELS_BY_NUMBER.get(self.number)


def find_servos(
    port: str, ids: Sequence[int], rates: Sequence[int] = BAUD_RATES, timeout_s: float = 0.01
) -> list[FoundServo]:
    """Find the servos with the given ids that answer at the given rates.

    Raises:
        OSError: The port cannot be opened.
    """
    found = []
    for baud in rates:
        bus = opened_bus(port, baud, timeout_s)
        try:
            for servo_id in ids:
                with contextlib.suppress(TimeoutError, RuntimeError):
                    number, firmware = bus.ping(servo_id)
                    found.append(FoundServo(baud=baud, servo_id=servo_id, number=number, firmware=firmware))
        finally:
            bus.close()
    return found


class Guide:
    """Ask a person to move an arm, and read it meanwhile.

    Args:
        bus: Bus of the servos.
        servos: Servos in joint order, all of known models.
        say: Shows a line to the person.
        answer: Returns the person's next line within a time in s, or None.
        forget: Discards input typed before a question.
    """

    def __init__(
        self,
        bus: DynamixelBus,
        servos: Sequence[FoundServo],
        say: Callable[[str], None],
        answer: Callable[[float], str | None],
        forget: Callable[[], None] = lambda: None,
    ) -> None:
        self._bus = bus
        self._servos = servos
        self._say = say
        self._answer = answer
        self._forget = forget
        self._read = SyncRead(PRESENT_POSITION, 4, [servo.servo_id for servo in servos], fast=False)
        self._last: Vector | None = None

    def loosen(self) -> None:
        """End all torque, verify it, and report homing offsets.

        Raises:
            OSError: The port fails, or a servo does not answer.
            RuntimeError: A servo keeps its torque.
        """
        self._bus.write(DynamixelBus.BROADCAST, TORQUE_ENABLE, b"\0")
        for servo in self._servos:
            answer_all(self._bus, servo.servo_id)
            if self._bus.read(servo.servo_id, TORQUE_ENABLE, 1) != b"\0":
                message = f"servo {servo.servo_id} keeps its torque: cut its supply"
                raise RuntimeError(message)
            ticks = int.from_bytes(self._bus.read(servo.servo_id, HOMING_OFFSET, 4), "little", signed=True)
            if ticks:
                self._say(
                    f"servo {servo.servo_id} has a homing offset of {ticks} ticks: it is in all angles here; whoever"
                    " changes it calibrates anew"
                )

    def pose(self, pose: Sequence[float]) -> Vector:
        """Return p of each servo while the person holds the arm in a pose, given in joint angles in rad."""
        angles = ", ".join(f"{q:g}" for q in pose)
        while True:
            self._ask(f"put the arm into the pose ({angles}) rad and press Enter")
            first = self._angles()
            self._wait(0.2)
            second = self._angles()
            if np.abs(second - first).max() <= STILL_RAD:
                return second
            self._say("it moved: once more")

    def directions(self) -> list[int]:
        """Return 1 or -1 for each joint, from turning them one after the other.

        A joint's reference is its angle at its first prompt, so a person who moves it back before a retry turns it the
        wrong way first. The other joints may stay or move back.
        """
        signs = []
        for joint, servo in enumerate(self._servos):
            begun = self._angles()
            while True:
                before = self._angles()
                self._ask(
                    f"turn joint {joint + 1} (servo {servo.servo_id}) by {TURNED_RAD:g} rad or more in its positive"
                    " direction, hold the others, and press Enter"
                )
                now = self._angles()
                moved = now - begun
                others = np.delete(np.minimum(np.abs(moved), np.abs(now - before)), joint)
                if len(others) and others.max() > max(BESIDE_RAD, 0.5 * abs(moved[joint])):
                    other = int(np.delete(np.arange(len(moved)), joint)[others.argmax()])
                    self._say(f"joint {other + 1} (servo {self._servos[other].servo_id}) moved instead: once more")
                elif abs(moved[joint]) < TURNED_RAD:
                    self._say(f"it moved {abs(moved[joint]):.2f} rad: must be {TURNED_RAD:g} at least: once more")
                else:
                    signs.append(1 if moved[joint] > 0.0 else -1)
                    break
        return signs

    def ranges(self) -> tuple[Vector, Vector]:
        """Return the smallest and largest p of each joint while the person moves all joints."""
        low, high = self._angles(), self._angles()

        def seen(angles: Vector) -> None:
            np.minimum(low, angles, out=low)
            np.maximum(high, angles, out=high)

        self._ask("move each joint through all of the range that it shall have, and press Enter", seen)
        return low, high

    # ------------------------------------------------------------------------------------------------------ asking

    def _ask(self, what: str, seen: Callable[[Vector], None] | None = None) -> None:
        """Read and show the angles until the person presses Enter."""
        self._forget()
        self._say(what)
        passed_s = 0.0
        while self._answer(READ_S) is None:
            angles = self._angles()
            if seen is not None:
                seen(angles)
            passed_s += READ_S
            if passed_s >= SHOWN_S:
                passed_s = 0.0
                self._say("\r" + " ".join(f"{p:+7.3f}" for p in angles))
        if seen is not None:
            seen(self._angles())

    def _wait(self, duration_s: float) -> None:
        for _ in range(round(duration_s / READ_S)):
            self._angles()
            self._answer(READ_S)

    def _angles(self) -> Vector:
        """Return p of each servo in rad, continuous across turns."""
        ticks = np.frombuffer(self._bus.sync_read(self._read), "<i4")
        angles: Vector = (ticks - CENTRE) * RAD_PER_TICK
        if self._last is not None:
            angles -= TURN * np.round((angles - self._last) / TURN)
        self._last = angles
        return angles.copy()


def calibrated(
    servos: Sequence[FoundServo],
    pose: Sequence[float],
    at_pose: Vector,
    signs: Sequence[int],
    ranges: tuple[Vector, Vector] | None,
    *,
    rounded: bool,
    margin_rad: float = 0.0,
) -> tuple[tuple[ServoSettings, ...], Vector]:
    """Return the calibrated servos, and the rounding residual of each offset in rad.

    Args:
        servos: Servos in joint order, of known models.
        pose: Joint angles q of the pose.
        at_pose: Servo angles p in the pose.
        signs: Sign of each joint, 1 or -1.
        ranges: Smallest and largest p; None for one turn around the pose.
        rounded: True to round offsets to multiples of pi/2.
        margin_rad: Margin between the shown range and the limits.

    Raises:
        ValueError: A range is not wider than its margins.
    """
    settings, left = [], np.zeros(len(servos))
    for joint, servo in enumerate(servos):
        sign, q = signs[joint], pose[joint]
        offset = float(at_pose[joint]) - sign * q
        if rounded:
            whole = QUARTER * round(offset / QUARTER)
            left[joint] = offset - whole
            offset = whole
        low, high = q - math.pi, q + math.pi
        if ranges is not None:
            ends = sorted(sign * (float(end[joint]) - offset) for end in ranges)
            low, high = ends[0] + margin_rad, ends[1] - margin_rad
            if not low < high:
                message = (
                    f"joint {joint + 1} (servo {servo.servo_id}) was moved {ends[1] - ends[0]:.3f} rad: must be more"
                    f" than twice the margin of {margin_rad:g}"
                )
                raise ValueError(message)
        model = servo.model
        if model is None:
            message = f"servo {servo.servo_id}: model {servo.number} is not known"
            raise ValueError(message)
        settings.append(
            ServoSettings(
                servo_id=servo.servo_id,
                model=model.name,
                sign=sign,
                # The limits determine the turn.
                offset_rad=math.remainder(offset, TURN),
                low_rad=low,
                high_rad=high,
                near_rad=min(max(q, low), high) if high - low > TURN else None,
                mode=OperatingMode.CURRENT if model.has_current_control else OperatingMode.EXTENDED_POSITION,
            )
        )
    return tuple(settings), left
