"""What a haptic device is to Haptether: four methods that a driver has."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable


class MasterSample(NamedTuple):
    """What a haptic device has measured."""

    position: float | Sequence[float]
    """x in m (rad for joints); for several axes shape `(axes,)`."""
    velocity: float | Sequence[float] | None = None
    """V in m/s from a device that measures it, at every sample or at none."""
    clutch: bool | None = None
    """Whether the clutch is pressed; none without a button."""
    fault: str | None = None
    """What the device says is wrong with it; the force stays zero while there is something, and until the operator at
    this side acknowledges it."""
    trigger: float | None = None
    """What leads the slave's gripper, 0 (open) to 1 (closed); none without one: the gripper then stays as it is."""
    orientation: Sequence[float] | None = None
    """R of a device of kind "pose", as a unit quaternion w, x, y, z that leads from its own frame to the base's."""
    angular_velocity: Sequence[float] | None = None
    """w in rad/s in the base frame from a device that measures it, at every sample or at none."""
    buttons: int | None = None
    """Bit n: button n is pressed; none where they are not known, which is no release. What they do is said by
    `[master.buttons]` of the scene."""
    time_s: float | None = None
    """Time in s of this sample on the device's own clock, at every sample or at none. It never goes back but after a
    fault. Two reads of one sample have the same time. A counter of samples times their period will do."""


@runtime_checkable
class MasterDevice(Protocol):
    """A haptic device: `read -> tick -> write` at each sample, on one thread.

    An exception ends the run: the force goes to zero, and the peer is notified. A `read` or `write` that blocks for
    more than 20 ms holds both sides; one of 0.5 s is a fault. Loaded by the name of an entry point of the group
    `haptether.masters`, which is called with the options of the command line as keywords. A driver may have
    `acknowledge()`, called when the operator at this side says that a fault is mended.

    A driver may have `kinds`, those of the scenes that it can be in: "linear", "joints", "pose"; without it, the first
    two. In a scene of kind "pose" every sample has an orientation, and `write` is called with force and torque.

    A driver whose trigger has a motor has `write_trigger(force_n)`: in a scene with `[master.gripper]` it is called
    after each `write`, with F_device in N at the finger, positive closing, to be exerted until the next call. Without
    it such a scene is refused; in other scenes it is not called.

    A driver whose device exerts a force by itself from `open` on, also while zero is written, such as against its
    weight, has `exerts_by_itself = True`; without it, it is False. `haptether check-device` and `identify` say so
    before they open it, and ask a person on the terminal; `haptether master` says so.

    A driver may have `speed_bound` in m/s (rad/s of joints), which its device cannot exceed. A faster step of its
    position that stays is a fault; `check-device` uses the same bound. `[master] speed_bound` of a scene overrides it.
    The default is 20 m/s, for joints 60 rad/s.

    A driver that paces the loop may have `period_s`, the seconds between two samples, known once it is open. A scene
    whose `[run] period_s` is off by more than 1 % is refused then, before any force. One of a bus may have `cycle_s`,
    the least time in s of a cycle there, known once it is open: a shorter period is refused.
    """

    paces: bool
    """Whether `read` waits for the next sample; else Haptether waits, by its own clock, after each `write`."""

    def open(self) -> None:
        """Connects; called once, before the first `read`."""

    def read(self) -> MasterSample:
        """The newest sample."""

    def write(self, force: tuple[float, ...]) -> None:
        """Exerts F_device in N, shape `(axes,)`, until the next call.

        A driver of kind "pose" has `write(force, torque=None)`: the torque in N m, in the base frame about the tool
        point.
        """

    def close(self) -> None:
        """Disconnects; called once, also after an exception, when zero was written last.

        Where the command is ended while another method blocks, it is called on another thread, after 1 s; before it
        `write` with zero, unless that method is `open`.
        """
