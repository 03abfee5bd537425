"""The grippers: stroke, speed and force of each, and how their counts of 0 to 255 become SI units."""

from dataclasses import dataclass
from typing import Final

from haptether.slave.gripper import MAX_SPEED, GripperCommand

MAX_COUNT: Final = 255


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotiqModel:
    """A gripper as its maker describes it; speed and force are taken as linear in their counts.

    Source: that of each range stands beside it, below.
    """

    name: str
    stroke_m: float
    """Between the jaws when they are open."""
    speed_m_s: tuple[float, float]
    """Of the width between the jaws, at a count of 0 and of 255."""
    force_n: tuple[float, float]
    """At a count of 0, which is not zero force, and of 255."""
    counts: tuple[int, int]
    """What POS reads at the open and at the closed end; fingers of another shape end elsewhere."""


ROBOTIQ_MODELS: Final = {
    model.name: model
    for model in (
        RobotiqModel(
            name="2f-85",
            stroke_m=0.085,
            # pyRobotiqGripper 3.3.14; 0.150 m/s also in ros2_robotiq_gripper.
            speed_m_s=(0.020, 0.150),
            # 235 N: ros2_robotiq_gripper; 20 N: data sheet as remembered, not looked up.
            force_n=(20.0, 235.0),
            # Robotiq, "Encoder bytes of the adaptive gripper": about 3 and 230.
            counts=(3, 230),
        ),
        RobotiqModel(
            name="2f-140",
            stroke_m=0.140,
            # pyRobotiqGripper 3.3.14.
            speed_m_s=(0.030, 0.250),
            # Data sheet as remembered, not looked up.
            force_n=(10.0, 125.0),
            # Closed at about 230: sdurobotics/ur_rtde, work item 356; the open end is assumed to be that of a 2F-85.
            counts=(3, 230),
        ),
        RobotiqModel(
            name="hand-e",
            stroke_m=0.050,
            # pyRobotiqGripper 3.3.14.
            speed_m_s=(0.020, 0.150),
            # Data sheet as remembered, not looked up; an example of the manual has 130 N. Of the two the larger, with
            # which a force that is asked for is never exceeded.
            force_n=(20.0, 185.0),
            # Assumed to be those of a 2F-85.
            counts=(3, 230),
        ),
    )
}


@dataclass(frozen=True, slots=True)
class Scale:
    """Counts of one gripper to SI units and back.

    Args:
        model: The gripper.
        counts: What POS reads at its open and its closed end, the second larger.
    """

    model: RobotiqModel
    counts: tuple[int, int]

    def position(self, count: int) -> float:
        """Position p = (POS - open) / (closed - open), within 0 (open) and 1 (closed)."""
        opened, closed = self.counts
        return min(max((count - opened) / (closed - opened), 0.0), 1.0)

    def velocity(self, counts_per_s: float) -> float:
        """In 1/s, no faster than a sample may be."""
        opened, closed = self.counts
        return min(max(counts_per_s / (closed - opened), -MAX_SPEED), MAX_SPEED)

    def force_n(self, count: int) -> float:
        """In N, of a count of FOR."""
        low, high = self.model.force_n
        return low + (high - low) * count / MAX_COUNT

    def request(self, command: GripperCommand) -> dict[str, int]:
        """POS, SPE and FOR of a command; its ends are requested beyond those of the jaws, so that they are reached."""
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
