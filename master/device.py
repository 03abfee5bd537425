"""Interface of a haptic device driver: four methods."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable


class MasterSample(NamedTuple):
    """Measurements of a haptic device."""

    position: float | Sequence[float]
    """x in m (rad for joints), shape `(axes,)` for several axes."""
    velocity: float | Sequence[float] | None = None
    """V in m/s if the device measures it; present at every sample or at none."""
    clutch: bool | None = None
    """True while the clutch is pressed; None without a button."""
    fault: str | None = None
    """Fault of the device, or None. The force stays zero during a fault, and until the operator at this side
    acknowledges it.
    """
    trigger: float | None = None
    """Command of the slave's gripper, 0 (open) to 1 (closed); None leaves the gripper unchanged."""
    orientation: Sequence[float] | None = None
    """R of a device of kind "pose": unit quaternion w, x, y, z from its own frame to the base."""
    angular_velocity: Sequence[float] | None = None
    """w in rad/s in the base frame if the device measures it; present at every sample or at none."""
    buttons: int | None = None
    """Bit n: button n is pressed; None if unknown, which is not a release. `[master.buttons]` of the scene assigns
    functions.
    """
    time_s: float | None = None
    """Time of this sample in s on the device's own clock, present at every sample or at none.

    It never decreases, except after a fault. Two reads of one sample have the same time. A count of samples times their
    period is valid.
    """


@runtime_checkable
class MasterDevice(Protocol):
    """Haptic device: `read -> tick -> write` at each sample, on one thread.

    An exception ends the run: the force goes to zero, and the peer is notified. A `read` or `write` that blocks for
    more than 20 ms holds both sides; 0.5 s is a fault. The driver is loaded by an entry point of the group
    `haptether.masters`, with the options of the command line as keyword arguments. An optional `acknowledge()` is
    called when the operator at this side acknowledges a fixed fault.

    Optional `kinds` lists the supported kinds of scenes: "linear", "joints", "pose"; the default is the first two. In a
    scene of kind "pose" every sample has an orientation, and `write` is called with force and torque.

    A driver with a motor at the trigger has `write_trigger(force_n)`. In a scene with `[master.gripper]` it is called
    after each `write`, with F_device in N at the finger, positive closing, to be exerted until the next call. Without
    it such a scene is refused; in other scenes it is not called.

    A driver whose device exerts a force from `open` on even while zero is written, such as gravity compensation, sets
    `exerts_by_itself = True`; the default is False. `haptether check-device` and `identify` announce this and ask a
    person on the terminal before they open it; `haptether master` announces it.

    Optional `speed_bound` in m/s (rad/s for joints) is a speed that the device cannot exceed. A faster, persistent step
    of its position is a fault; `check-device` uses the same bound. `[master] speed_bound` of a scene overrides it. The
    default is 20 m/s, for joints 60 rad/s.

    A driver that paces the loop may have `period_s`, the seconds between two samples, known once it is open. A scene
    whose `[run] period_s` differs by more than 1 % is then refused, before any force. A driver on a bus may have
    `cycle_s`, the shortest bus cycle in s, known once it is open; a shorter period is refused.

    A driver whose `close` lowers an arm has `close_s`, the seconds that this takes; the end of a run waits for them,
    and for 5 s more.
    """

    paces: bool
    """True if `read` waits for the next sample; otherwise Haptether waits by its own clock after each `write`."""

    def open(self) -> None:
        """Connect; called once, before the first `read`."""

    def read(self) -> MasterSample:
        """Return the latest sample."""

    def write(self, force: tuple[float, ...]) -> None:
        """Exert F_device in N, shape `(axes,)`, until the next call.

        A driver of kind "pose" has `write(force, torque=None)`, with the torque in N m in the base frame about the tool
        point.
        """

    def close(self) -> None:
        """Disconnect; called once, also after an exception, after zero was written.

        If the command ends while another method blocks, `close` is called on another thread after 1 s. A `write` of
        zero precedes it, unless the blocked method is `open`.
        """
