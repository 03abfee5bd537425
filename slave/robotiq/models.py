"""Gripper models: stroke, speed and force, and the map from counts 0 to 255 to SI units."""

from dataclasses import dataclass
from typing import Final

from haptether.slave.gripper import MAX_SPEED, GripperCommand

MAX_COUNT: Final = 255


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotiqModel:
    """Gripper data from its maker; speed and force are taken as linear in their counts.

    Source: beside each range below.
    """

    name: str
    stroke_m: float
    """Distance between the open jaws."""
    speed_m_s: tuple[float, float]
    """Speed of the jaw distance at counts 0 and 255."""
    force_n: tuple[float, float]
    """Force at count 0, which is not zero force, and at 255."""
    counts: tuple[int, int]
    """POS at the open and the closed end; other fingers have other ends."""


ROBOTIQ_MODELS: Final = {
    model.name: model
    for model in (
        RobotiqModel(
            name="2f-85",
            stroke_m=0.085,
            # pyRobotiqGripper 3.3.14; 0.150 m/s also in ros2_robotiq_gripper.
            speed_m_s=(0.020, 0.150),
            # 235 N: ros2_robotiq_gripper; 20 N: data sheet from memory, not verified.
            force_n=(20.0, 235.0),
            # Robotiq, "Encoder bytes of the adaptive gripper": about 3 and 230.
            counts=(3, 230),
        ),
        RobotiqModel(
            name="2f-140",
            stroke_m=0.140,
            # pyRobotiqGripper 3.3.14.
            speed_m_s=(0.030, 0.250),
            # Data sheet from memory, not verified.
            force_n=(10.0, 125.0),
            # Closed at about 230: sdurobotics/ur_rtde, work item 356; the open end is assumed equal to the 2F-85.
            counts=(3, 230),
        ),
        RobotiqModel(
            name="hand-e",
            stroke_m=0.050,
            # pyRobotiqGripper 3.3.14.
            speed_m_s=(0.020, 0.150),
            # Data sheet from memory, not verified; an example in the manual has 130 N. The larger value ensures that a
            # requested force is never exceeded.
            force_n=(20.0, 185.0),
            # Assumed equal to the 2F-85.
            counts=(3, 230),
        ),
    )
}
"""Grippers by name."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Map between counts of one gripper and SI units.

    Args:
        model: Model of the gripper.
        counts: POS at the open and the closed end, the second larger.
    """

    model: RobotiqModel
    counts: tuple[int, int]

    def position(self, count: int) -> float:
        """Return the position p = (POS - open) / (closed - open), clipped to 0 (open) to 1 (closed)."""
        opened, closed = self.counts
        return min(max((count - opened) / (closed - opened), 0.0), 1.0)

    def velocity(self, counts_per_s: float) -> float:
        """Return the velocity in 1/s, clipped to the valid range of a sample."""
        opened, closed = self.counts
        return min(max(counts_per_s / (closed - opened), -MAX_SPEED), MAX_SPEED)

    def force_n(self, count: int) -> float:
        """Return the force in N for a count of FOR."""
        low, high = self.model.force_n
        return low + (high - low) * count / MAX_COUNT

    def request(self, command: GripperCommand) -> dict[str, int]:
        """Return POS, SPE and FOR of a command.

        The requested end positions lie beyond the jaw ends, so that the jaws reach their ends.
        """
        opened, closed = self.counts
        within = round(opened + command.position * (closed - opened))
        ends = {0.0: 0, 1.0: MAX_COUNT}
        return {
            "POS": ends.get(command.position, within),
            "SPE": _count(command.speed * self.model.stroke_m, self.model.speed_m_s),
            "FOR": _count(command.force_n, self.model.force_n),
        }


def _count(value: float, span: tuple[float, float]) -> int:
    low, high = span
    return round(min(max((value - low) / (high - low), 0.0), 1.0) * MAX_COUNT)
