"""What a robot arm is to Haptether: five methods that a driver has."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable


class SlaveSample(NamedTuple):
    """What an arm has measured."""

    position: float | Sequence[float]
    """Of the tool, in m (rad for joints); for several axes shape `(axes,)`."""
    velocity: float | Sequence[float]
    """Of the tool, in m/s."""
    force: float | Sequence[float]
    """F_e in N: of the environment on the tool."""
    fault: str | None = None
    """What the arm says is wrong with it; it is not moved while there is something, and until the operator at this side
    acknowledges it."""
    orientation: Sequence[float] | None = None
    """Of the tool, `quat_wxyz`: base_from_tool, of length 1."""
    angular_velocity: Sequence[float] | None = None
    """Of the tool in the frame of the base, in rad/s."""
    torque: Sequence[float] | None = None
    """Moment of the environment on the tool about the tool point, in the frame of the base, in N m."""
    time_s: float | None = None
    """Time in s of this sample on the arm's own clock, at every sample or at none. It never goes back but after a
    fault. Two reads of one sample have the same time. A counter of samples times their period will do."""


@runtime_checkable
class SlaveDevice(Protocol):
    """An arm: `read -> tick -> write` at each sample, on one thread.

    An exception ends the run: the arm is stopped, and the peer is notified. A `read` or `write` that blocks for more
    than 20 ms holds both sides; one of 0.5 s is a fault. Loaded by the name of an entry point of the group
    `haptether.slaves`, which is called with the options of the command line as keywords.

    A driver may have `acknowledge()`, called when the operator at this side says that a fault is mended; `axes`, held
    against those of the scene; and `max_speed` in m/s: `haptether slave` then lets no command be faster, for an arm
    that lags behind a faster one would go on after it was let go. One that paces the loop may have `period_s`, the
    seconds between two samples, known once it is open: a scene whose `[slave] period_s` is off by more than 1 % is
    refused then, before anything moves. One of a bus may have `cycle_s`, the least time in s of a cycle there, known
    once it is open: a shorter period is refused.

    A driver whose arm has torque of its own from `open` on, and may fall when it is closed, has `exerts_by_itself =
    True`: `check-device` and `haptether slave` say so before they open it.

    A driver may have `speed_bound` in m/s (rad/s of joints), which its arm cannot exceed. A faster step of its
    position that stays is a fault; `check-device` uses the same bound. `[slave] speed_bound` of a scene overrides it.
    The default is 20 m/s, for joints 60 rad/s.

    `kinds` names the kinds of sides that a driver can be: "linear", "joints", "pose"; without it the first two. One of
    poses has `write(position, velocity, orientation=None, angular_velocity=None)`, tuples of four and three as in a
    sample: without an orientation, in a scene of points, the tool keeps that of the begin. Its samples have
    orientation, angular velocity and torque.
    """

    paces: bool
    """Whether `read` waits for the next sample; else Haptether waits, by its own clock, after each `write`."""

    def open(self) -> None:
        """Connects; called once, before the first `read`. The arm does not move."""

    def read(self) -> SlaveSample:
        """The newest sample."""

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        """Takes the tool to a position in m that moves with a velocity in m/s, shape `(axes,)` each."""

    def stop(self) -> None:
        """Comes to rest softly and stays until the next `write`; never an emergency stop. May be called again."""

    def close(self) -> None:
        """Disconnects; called once, also after an exception, when the arm was commanded to stop.

        Where the command is ended while another method blocks, it is called on another thread, after 1 s; before it
        `stop`, unless that method is `open`.
        """
