"""Interface of an arm driver: five methods, and a sixth of an arm that takes forces."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable


class SlaveSample(NamedTuple):
    """Measurements of an arm."""

    position: float | Sequence[float]
    """Position of the tool in m (rad for joints), shape `(axes,)` for several axes."""
    velocity: float | Sequence[float]
    """Velocity of the tool in m/s."""
    force: float | Sequence[float]
    """F_e in N: force of the environment on the tool."""
    fault: str | None = None
    """Fault of the arm, or None. The arm is not moved during a fault, and until the operator at this side acknowledges
    it.
    """
    orientation: Sequence[float] | None = None
    """Orientation of the tool, `quat_wxyz`: base_from_tool, of length 1."""
    angular_velocity: Sequence[float] | None = None
    """Angular velocity of the tool in the base frame in rad/s."""
    torque: Sequence[float] | None = None
    """Moment of the environment on the tool about the tool point, in the base frame, in N m."""
    time_s: float | None = None
    """Time of this sample in s on the arm's own clock, present at every sample or at none.

    It never decreases, except after a fault. Two reads of one sample have the same time. A count of samples times their
    period is valid.
    """


@runtime_checkable
class SlaveDevice(Protocol):
    """Arm: `read -> tick -> write` at each sample, on one thread.

    An exception ends the run: the arm is stopped, and the peer is notified. A `read` or `write` that blocks for more
    than 20 ms holds both sides; 0.5 s is a fault. The driver is loaded by an entry point of the group
    `haptether.slaves`, with the options of the command line as keyword arguments.

    Optional members: `acknowledge()`, called when the operator at this side acknowledges a fixed fault; `axes`,
    compared with the scene; and `max_speed` in m/s. `haptether slave` limits commands to `max_speed`, because an arm
    that lags behind a faster command would continue to move after the release. A driver that paces the loop may have
    `period_s`, the seconds between two samples, known once it is open. A scene whose `[slave] period_s` differs by more
    than 1 % is then refused, before any motion. A driver on a bus may have `cycle_s`, the shortest bus cycle in s,
    known once it is open; a shorter period is refused.

    A driver whose `close` lowers the arm has `close_s`, the seconds that this takes; the end of a run waits for them,
    and for 5 s more.

    Optional `give_up()` is called on another thread if the command ends while `open` runs. It returns at once, and
    `open` raises an exception soon.

    A driver whose arm has torque from `open` on, and may fall when it is closed, sets `exerts_by_itself = True`:
    `check-device` and `haptether slave` announce this before they open it.

    Optional `speed_bound` in m/s (rad/s for joints) is a speed that the arm cannot exceed. A faster, persistent step of
    its position is a fault; `check-device` uses the same bound. `[slave] speed_bound` of a scene overrides it. The
    default is 20 m/s, for joints 60 rad/s.

    `kinds` lists the supported kinds of sides: "linear", "joints", "pose"; the default is the first two. A driver of
    poses has `write(position, velocity, orientation=None, angular_velocity=None)`, tuples of four and three as in a
    sample. Without an orientation, in a scene of points, the tool keeps its initial one. Its samples have orientation,
    angular velocity and torque.

    `takes_force = True` marks a driver with a sixth method, `write_force(force, torque=None)`. It exerts a force in N
    on the tool (N m for joints), shape `(axes,)`, until the next order. A pose also gets `torque` in N m about the tool
    point, in the base frame; without it the tool keeps its orientation. The driver adds what the arm needs for itself:
    gravity, friction, joint limits, and the directions that the scene does not command. It bounds force and speed, and
    its watchdog ends the force when orders cease. `write` and `stop` work as for any arm, in any order.
    """

    paces: bool
    """True if `read` waits for the next sample; otherwise Haptether waits by its own clock after each `write`."""

    def open(self) -> None:
        """Connect; called once, before the first `read`. The arm does not move."""

    def read(self) -> SlaveSample:
        """Return the latest sample."""

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        """Move the tool to a position in m that itself moves at a velocity in m/s, shape `(axes,)` each."""

    def stop(self) -> None:
        """Come to rest softly and stay until the next `write`; never an emergency stop. May be repeated."""

    def close(self) -> None:
        """Disconnect; called once, also after an exception, after a stop command.

        If the command ends while another method blocks, `close` is called on another thread after 1 s. `stop` precedes
        it, unless the blocked method is `open`.
        """
