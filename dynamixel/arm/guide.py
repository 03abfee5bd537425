"""A person and an arm without torque: where its zero is, which way its joints turn, and how far."""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from haptether._core import DynamixelBus, SyncRead
from haptether.dynamixel.arm.arm import Vector
from haptether.dynamixel.arm.checks import answer_all
from haptether.dynamixel.arm.settings import TURN, ServoSettings
from haptether.dynamixel.control_table import CENTRE, HOMING_OFFSET, PRESENT_POSITION, RAD_PER_TICK, TORQUE_ENABLE
from haptether.dynamixel.models import BAUD_RATES, SERVO_MODELS_BY_NUMBER, OperatingMode, ServoModel

STILL_RAD: Final = 0.01
"""A pose is taken while no joint moves more between two reads."""
TURNED_RAD: Final = 0.2
"""So far a joint is turned to show its direction."""
BESIDE_RAD: Final = 0.1
"""At most so far another joint moves meanwhile."""
SHOWN_S: Final = 0.2
"""Between two lines of live angles."""
READ_S: Final = 0.01
QUARTER: Final = 0.5 * math.pi


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundServo:
    """A servo that answers."""

    baud: int
    servo_id: int
    number: int
    firmware: int

    @property
    def model(self) -> ServoModel | None:
        """What it is; none of a number that no table here has."""
        return SERVO_MODELS_BY_NUMBER.get(self.number)


def find_servos(
    port: str, ids: Sequence[int], rates: Sequence[int] = BAUD_RATES, timeout_s: float = 0.01
) -> list[FoundServo]:
    """The servos of these ids that answer at these rates.

    Raises:
        OSError: The port cannot be opened.
    """
    found = []
    for baud in rates:
        bus = DynamixelBus(port, baud=baud, timeout_s=timeout_s)
        try:
            for servo_id in ids:
                with contextlib.suppress(TimeoutError, RuntimeError):
                    number, firmware = bus.ping(servo_id)
                    found.append(FoundServo(baud=baud, servo_id=servo_id, number=number, firmware=firmware))
        finally:
            bus.close()
    return found


class Guide:
    """Asks a person to move an arm, and reads it meanwhile.

    Args:
        bus: Of the servos.
        servos: In the order of the joints, all of known models.
        say: Takes a line for the person.
        answer: The person's next line within so many seconds; none yet: none.
        forget: Drops what was typed before a question.
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
        """Ends all torque, verified, and names homing offsets.

        Raises:
            OSError: The port, or a servo that does not answer.
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
        """P of each servo while the arm is in a pose, angles of the joints in rad, that the person puts it into."""
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
        """1 or -1 of each joint, by turning one after the other.

        A joint counts from where it stood at its first prompt, however often it is asked for: who puts it back before
        another try turns it the wrong way at first. The others may be put back, too, or stay where they were.
        """
        signs = []
        for joint, servo in enumerate(self._servos):
            begun = self._angles()
            while True:
                before = self._angles()
                self._ask(
                    f"turn joint {joint + 1} (servo {servo.servo_id}) by 0.3 rad or more in its positive direction,"
                    " hold the others, and press Enter"
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
        """Least and greatest p of each joint while the person moves all of them."""
        low, high = self._angles(), self._angles()

        def seen(angles: Vector) -> None:
            np.minimum(low, angles, out=low)
            np.maximum(high, angles, out=high)

        self._ask("move each joint through all of the range that it shall have, and press Enter", seen)
        return low, high

    # ------------------------------------------------------------------------------------------------------ asking

    def _ask(self, what: str, seen: Callable[[Vector], None] | None = None) -> None:
        """Until the person presses Enter: reads all the time, and shows the angles."""
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
        """P of each servo in rad, through the end of a turn."""
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
    """Servos as an arm, and what rounding left over of each offset in rad.

    Args:
        servos: In the order of the joints, of known models.
        pose: q of the pose.
        at_pose: p in it.
        signs: 1 or -1 of each.
        ranges: Least and greatest p; none for a turn about the pose.
        rounded: Offsets to multiples of pi/2.
        margin_rad: By which limits are inside of what was shown.

    Raises:
        ValueError: A range that is no wider than its margins.
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
                # The limits say which turn.
                offset_rad=math.remainder(offset, TURN),
                low_rad=low,
                high_rad=high,
                near_rad=min(max(q, low), high) if high - low > TURN else None,
                mode=OperatingMode.CURRENT if model.has_current_control else OperatingMode.EXTENDED_POSITION,
            )
        )
    return tuple(settings), left
