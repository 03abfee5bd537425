"""An emulated leader arm with a scripted hand, for demonstrations."""

import contextlib
import math
import socket
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from haptether.bridge import load_scene
from haptether.dynamixel.description import ArmDescription, ArmKinematics, load_arm
from haptether.dynamixel.emulator import servos_of
from haptether.master.dynamixel import pose_model

if TYPE_CHECKING:
    from haptether.studies.processes import StopRequest

Array = npt.NDArray[np.float64]

LEADER: Final = "gello-ur"
LEADER_S: Final = 2.5
"""Extra time for the grasp, the engagement and the rise of all torques."""
SETTLE_S: Final = 1.5
"""Delay before the hand begins."""
ROW_S: Final = 0.02
HAND: Final = (60.0, 60.0, 60.0, 15.0, 15.0, 15.0, 2.0)
"""Stiffness of the hand at each joint and at the trigger in N m/rad; chosen as 1 kN/m at the tool's distance."""
HAND_DAMPING: Final = (1.0, 1.0, 1.0, 0.2, 0.2, 0.2, 0.02)
"""Damping in N m s/rad; chosen."""
SLOW: Final = ("timeout_s=0.1", "watchdog_s=0.5")
"""Driver options for several processes on one busy machine, which answer late."""
CLUTCH: Final = ("--clutch", "auto")
"""Clutch option: automatic, because a press at the start of a slowly loading process is void."""
STEPS: Final = 20
"""Most iterations of Newton's method per point."""
NEAR: Final = 1e-9


class Emulated:
    """Control line of an emulated bus."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        self._socket = socket.create_connection((host, int(port)), timeout=5.0)
        self._lines = self._socket.makefile("r", encoding="utf-8")

    def say(self, line: str) -> str:
        """Send a line and return the answer.

        Raises:
            RuntimeError: The bus refused the line.
        """
        self._socket.sendall(f"{line}\n".encode())
        answer = self._lines.readline().strip()
        if not answer.startswith("ok"):
            message = f"the emulated bus said to {line!r}: {answer or 'nothing'}"
            raise RuntimeError(message)
        return answer.removeprefix("ok").strip()

    def close(self) -> None:
        """Close the connection."""
        self._lines.close()
        self._socket.close()


@dataclass
class Leader:
    """An emulated leader, held by a hand at its start."""

    arm: ArmDescription
    emulated: Emulated
    port: str
    options: tuple[str, ...]
    """Options of `haptether master`."""
    folder: Path

    def hold(self) -> None:
        """Let the hand hold all joints and the trigger."""
        q = [joint.start_rad for joint in self.arm.joints]
        for servo, place, stiffness, damping in zip(
            self.servo_ids, self.servo_angles(np.array(q), 0.0), HAND, HAND_DAMPING, strict=True
        ):
            self.emulated.say(f"hand {servo} {place:.6f} {stiffness} {damping}")

    def prepare(self, duration_s: float) -> None:
        """Write the hand's path of the scene `ur_pick`; this takes long."""
        self._path.write_text(hand_path(self, duration_s), encoding="utf-8")

    def lead(self, stopped: "StopRequest") -> None:
        """Begin to lead the arm along the prepared path."""
        stopped.sleep(SETTLE_S)
        if not stopped:
            self.emulated.say(f"lead {self._path}")

    @property
    def _path(self) -> Path:
        return self.folder / "hand.csv"

    @property
    def servo_ids(self) -> list[int]:
        """Servos of the joints, then of the trigger."""
        trigger = [] if self.arm.trigger is None else [self.arm.trigger.servo]
        return [*(joint.servo for joint in self.arm.joints), *trigger]

    def servo_angles(self, q: Array, closed: float) -> list[float]:
        """Servo angles for joint angles and a trigger, 0 open to 1 closed."""
        angles = [joint.sign * float(at) + joint.offset_rad for joint, at in zip(self.arm.joints, q, strict=True)]
        if (trigger := self.arm.trigger) is not None:
            angles.append(trigger.open_rad + closed * (trigger.closed_rad - trigger.open_rad))
        return angles


def led_leader(limit: str, stack: contextlib.ExitStack, stopped: "StopRequest", kind: str = "pose") -> Leader:
    """Start an emulated leader for `limit` s, held by a hand."""
    leader = emulated_arm(limit, stack, stopped)
    leader.hold()
    arm = leader.arm
    own = [servo.joint.settings.inertia for servo in servos_of(arm, baud=4_000_000, firmware=52)][: len(arm.joints)]
    links = ArmKinematics(arm).link_inertia([joint.start_rad for joint in arm.joints])
    options = [
        "master.driver=dynamixel", f"master.options.port={leader.port}", f"master.options.arm={LEADER}",
        f"master.options.offsets={[joint.offset_rad for joint in leader.arm.joints]}",
        f"master.options.signs={[joint.sign for joint in leader.arm.joints]}",
        # Torque constants of the emulated servos.
        f"master.options.torque_constant={[joint.servo_model.nominal_nm_per_a for joint in arm.joints]}",
        f"master.options.kind={kind}", "run.period_s=0.004", *(f"master.options.{key}" for key in SLOW),
    ]  # fmt: skip
    if kind == "pose":
        model = pose_model(arm, inertia=[one - link for one, link in zip(own, links, strict=True)])
        options += [
            f"master.mass_kg={list(model.mass_kg)}", f"master.rotation.inertia_kg_m2={list(model.inertia_kg_m2)}",
        ]  # fmt: skip
    leader.options = (*CLUTCH, *(part for option in options for part in ("--set", option)))
    return leader


def emulated_arm(limit: str, stack: contextlib.ExitStack, stopped: "StopRequest", *more: str) -> Leader:
    """Start an emulated bus with the leader's servos for `limit` s."""
    from haptether.studies.processes import child_process

    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    port = free_port()
    process = stack.enter_context(child_process(
        "dynamixel-emulator", "--arm", LEADER, "--duration-s", limit, "--control", f"127.0.0.1:{port}",
        "--socket", str(folder / "bus"), *more, says="servos ",
    ))  # fmt: skip
    process.headline(stopped)
    emulated = Emulated(f"127.0.0.1:{port}")
    stack.callback(emulated.close)
    return Leader(load_arm(LEADER), emulated, str(folder / "bus"), (), folder)


def free_port() -> int:
    """Free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def hand_path(leader: Leader, duration_s: float) -> str:
    """The hand's path of the scene as servo angles: a CSV for the control line's `lead`."""
    scene = load_scene("ur_pick")
    operator = scene.operator
    assert operator is not None
    assert operator.rotation is not None
    kinematics = ArmKinematics(leader.arm)
    q = np.array([joint.start_rad for joint in leader.arm.joints])
    place, quat, _ = kinematics.state(q, np.zeros(len(q)))
    begin, upright = np.array(place), np.array(quat)
    moves = [(leg.duration_s, np.array(leg.end, dtype=float)) for leg in operator.legs]
    turns = [(leg.duration_s, np.array(leg.turn, dtype=float)) for leg in operator.rotation.legs]
    times, closed = np.array(operator.trigger).T
    lines = ["time_s," + ",".join(map(str, leader.servo_ids))]
    for row in range(round(duration_s / ROW_S) + 1):
        at_s = row * ROW_S
        turned = turn_quat(along(turns, at_s, absolute=False))
        q = solved(kinematics, q, begin + along(moves, at_s, absolute=True), product(turned, upright))
        trigger = float(np.interp(at_s, times, closed))
        lines.append(",".join(f"{number:.9g}" for number in (at_s, *leader.servo_angles(q, trigger))))
    return "\n".join(lines) + "\n"


def along(legs: list[tuple[float, Array]], at_s: float, *, absolute: bool) -> Array:
    """Position on minimum-jerk legs from 0 at a time; ends are positions if `absolute`, else offsets."""
    at, begun_s = np.zeros(3), 0.0
    for duration_s, end in legs:
        goal = end if absolute else at + end
        r = min(max((at_s - begun_s) / duration_s, 0.0), 1.0)
        at = at + (goal - at) * r**3 * (10.0 + r * (6.0 * r - 15.0))
        if r < 1.0:
            break
        begun_s += duration_s
    return at


def solved(kinematics: ArmKinematics, q: Array, place: Array, quat: Array) -> Array:
    """Joint angles near q that bring the tool to a pose, by Newton's method.

    Raises:
        RuntimeError: There are none nearby.
    """
    still = np.zeros(len(q))
    for _ in range(STEPS):
        seen, turned, _ = kinematics.state(q, still)
        w, *v = product(quat, np.array((turned[0], -turned[1], -turned[2], -turned[3])))
        axis = np.array(v) if w >= 0.0 else -np.array(v)
        length = float(np.linalg.norm(axis))
        angle = 2.0 * math.atan2(length, abs(float(w)))
        error = np.concatenate((place - seen, axis * (angle / length if length > 0.0 else 2.0)))
        if float(np.abs(error).max()) < NEAR:
            return q
        q = q + np.linalg.lstsq(kinematics.jacobian(q), error, rcond=None)[0]
    message = f"the leader's arm cannot bring its tool to {place.round(3).tolist()}"
    raise RuntimeError(message)


def product(one: Array, other: Array) -> Array:
    """Hamilton's product of quaternions w, x, y, z."""
    w, v, s, u = one[0], one[1:], other[0], other[1:]
    return np.concatenate(([w * s - v @ u], w * u + s * v + np.cross(v, u)))


def turn_quat(turn: Array) -> Array:
    """Quaternion of an axis times an angle in rad."""
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 0.0 else np.zeros(3)
    return np.concatenate(([math.cos(0.5 * angle)], math.sin(0.5 * angle) * axis))
