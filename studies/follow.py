"""Demonstration of two servo arms: a hand leads one; the other grips, carries and is pushed."""

import contextlib
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge import read_recording, write_key
from haptether.dynamixel.arm import calibration_text
from haptether.dynamixel.description import ArmDescription, Trigger
from haptether.dynamixel.emulator import JointSettings, servos_of
from haptether.master.dynamixel.options import LeaderOptions, arm_settings
from haptether.studies.leader import CLUTCH, LEADER, ROW_S, Leader, along, emulated_arm
from haptether.studies.processes import (
    END_TIMEOUT_S,
    START_TIMEOUT_S,
    Process,
    StopRequest,
    child_process,
    slave_behind,
    until_ended,
)
from haptether.view.style.colours import AXES, SIGNALS, controller_look, controller_title
from haptether.view.style.figure import Columns, letter, new_figure, styled, write_figure
from haptether.view.style.legend import legend_above, legend_beside

FOLLOW_CONTROLLERS: Final = ("none", "hsc", "wsc")
"""Controllers of the demonstration with servo arms, a run each."""
JOINT: Final = 2
"""Pushed joint, counted from 1."""
OBJECT: Final = 0.5
"""Jaw position at contact with the object, 0 (open) to 1 (closed)."""
BEGUN: Final = 0.05
"""Trigger value that marks the start; the trigger rests at 0."""
GRIP_N: Final = 1.5
"""Grip force below that of the smallest servo."""
WITHIN_RAD: Final = 0.03
"""Largest carry error in rad of each joint: friction of both arms and one encoder step."""
NEAR: Final = ("time_s", "position", "velocity", "device_force", "trigger_device_force")
ENGAGED: Final = 2
"""Ladder state code in a trace."""
SCENE: Final = """\
schema = 1
title = "A leader and a follower of servos"

[run]
period_s = 0.004
duration_s = {duration_s}

[master]
kind = "joints"
axes = {axes}
mass_kg = {mass}       # kg m^2
viscous = {viscous}    # N m s/rad
coulomb = {coulomb}    # N m
friction = "axis"
encoder_quantum = 1.5339808e-3 # rad
driver = "dynamixel"

[master.options]
port = "{leader}"
arm = "{arm}"
offsets = {offsets} # rad: the emulated unit is as it is described
signs = {signs}
torque_constant = {constants} # of the emulated servos
timeout_s = 0.1
watchdog_s = 0.5

[master.gripper]
travel_m = {travel}
mass_kg = {finger_mass}
viscous = {finger_viscous}
coulomb = {finger_coulomb}
encoder_quantum = {finger_quantum}
force_scale = 0.3

[slave]
device = "dynamixel"
period_s = 0.004

[slave.options]
port = "{follower}"
arm = "{file}"
max_speed = 6.0
timeout_s = 0.1
watchdog_s = 0.5
lost_after_s = 0.3

[slave.gripper]
device = "dynamixel"
speed = 1.8
force_n = {grip_n}

[slave.gripper.options]
id = {grip_id}
model = "{grip_model}"
open_rad = {open_rad}
closed_rad = {closed_rad}
lever_m = {lever}
torque_constant = {grip_constant}

[safety]
controllers = {controllers}
velocity_threshold = 1.0     # rad/s
hsc_force_threshold_n = 0.1  # N m
"""


class FollowScene(msgspec.Struct, frozen=True, kw_only=True):
    """Course of the demonstration. Times in s since the hand begins."""

    delay_s: float = 0.02
    jitter_s: float = 0.001
    loss: float = 0.01
    seed: int = 1
    settle_s: float = 2.5
    """Time from the start of the master: its checklist, and the rise of its torque."""
    led_rad: float = 0.3
    """Angle by which the hand leads each joint while the follower holds the object."""
    close_at_s: float = 0.3
    carry_at_s: float = 1.4
    carry_s: float = 1.6
    open_at_s: float = 3.5
    push_at_s: float = 4.6
    push_nm: float = 0.5
    release_at_s: float = 5.4
    push_ends_s: float = 5.9
    duration_s: float = 6.6


class FollowResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result at leader and follower, in rad, rad/s, N and N m."""

    controller: str
    grips: int
    """Number of times that the follower gripped an object."""
    grip_n: float
    """Grip force from the motor current."""
    finger_n: float
    """Largest force at the trigger felt by the finger."""
    open_at_end: bool
    led_rad: float
    """Smallest angle by which a joint of the leader was led."""
    carried_rad: float
    """Smallest angle by which a joint of the follower moved while holding the object."""
    felt_nm: float
    """Largest reflected torque at the joint while the hand held it."""
    thrown_rad_s: float
    """Largest joint speed after the release."""
    final_state: str
    holds: int

    @property
    def is_carried(self) -> bool:
        """True if the object was gripped once, carried by all joints as far as led, and released."""
        return self.grips == 1 and self.open_at_end and abs(self.carried_rad - self.led_rad) < WITHIN_RAD


def run_follow(
    scene: FollowScene, controller: str, folder: Path, show: Callable[[str, float], None], stopped: StopRequest
) -> FollowResult:
    """Run both arms, the network and both sides once; arguments as for `run_demo`.

    Raises:
        Interrupted: A stop was requested; all processes have ended.
        RuntimeError: A process failed; the message contains its output.
    """
    lasts_s = scene.settle_s + scene.duration_s + 1.0
    # Counted from each process's start, because the others may start slowly.
    limit = str(lasts_s + 5 * START_TIMEOUT_S + END_TIMEOUT_S)
    trace, result, recording = (folder / f"follow-{controller}.{end}" for end in ("npz", "json", "mcap"))
    with contextlib.ExitStack() as stack:
        show(f"{controller}: starting", 0.0)
        private = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        key, file, text = private / "demo.key", private / "follower.toml", private / "scene.toml"
        write_key(key)
        leader = emulated_arm(limit, stack, stopped)
        trigger = trigger_of(leader.arm)
        met = trigger.open_rad + OBJECT * (trigger.closed_rad - trigger.open_rad)
        # A follower's driver does not know its arm's weight, which would be felt as a load, so it is zero here.
        follower = emulated_arm(limit, stack, stopped, "--mass-scale", "0",
                                "--stops", f"{trigger.servo}={trigger.open_rad}:{met}")  # fmt: skip
        leader.hold()
        file.write_text(follower_file(leader.arm), encoding="utf-8")
        text.write_text(scene_text(scene, controller, leader.arm, (leader.port, follower.port), file), encoding="utf-8")
        slave, address = slave_behind(
            scene, limit, stack, stopped, "--scene", str(text), "--key", str(key), "--record", str(recording),
            "--force", "--min-free-bytes", "0",
        )  # fmt: skip
        master = stack.enter_context(child_process(
            "master", "--scene", str(text), "--peer", address, "--listen", "127.0.0.1:0", "--key", str(key),
            "--duration-s", str(lasts_s), "--trace", str(trace), "--force", "--json", str(result), *CLUTCH,
        ))  # fmt: skip
        master.headline(stopped)
        stopped.sleep(scene.settle_s)
        whole = _play(
            scene, master, (leader, follower), lambda stage, at_s: show(f"{controller}: {stage}", at_s), stopped
        )
        if master.process.returncode != 0 or not whole:
            raise RuntimeError(master.failure(slave))
        # The recording is complete once the slave has ended.
        slave.end()
        far = read_recording(recording).signals
    report = msgspec.json.decode(result.read_bytes())
    with np.load(trace) as arrays:
        near = {name: arrays[name] for name in NEAR}
    return measured(controller, near, far, report)


def _play(
    scene: FollowScene, master: Process, arms: tuple[Leader, Leader],
    show: Callable[[str, float], None], stopped: StopRequest,
) -> bool:  # fmt: skip
    """Run the hand and the push until the master ends; return True if all steps happened."""
    leader, follower = arms
    joint = leader.arm.joints[JOINT - 1]
    path = leader.folder / "hand.csv"
    path.write_text(hand_path(scene, leader), encoding="utf-8")
    events = [
        (0.0, "the hand leads joints and gripper", leader, f"lead {path}"),
        (scene.push_at_s, "the follower is pushed", follower, f"push {joint.servo} {-joint.sign * scene.push_nm}"),
        (scene.release_at_s, "the hand has let go", leader, f"hand {joint.servo} off"),
        (scene.push_ends_s, "the push has ended", follower, f"push {joint.servo} 0"),
    ]
    stage = ""

    def each(at_s: float) -> None:
        nonlocal stage
        if events and at_s >= events[0][0]:
            _, stage, arm, line = events.pop(0)
            arm.emulated.say(line)
        show(stage, min(at_s, scene.duration_s))

    until_ended(master, scene.duration_s, each, stopped)
    return not events


def hand_path(scene: FollowScene, leader: Leader) -> str:
    """Return the hand's path as servo angles: the trigger closes, all joints move, the trigger opens."""
    times = scene.close_at_s, scene.close_at_s + 0.5, scene.open_at_s, scene.open_at_s + 0.4
    closed = 0.0, 1.0, 1.0, 0.0
    legs = [(scene.carry_at_s, np.zeros(3)), (scene.carry_s, np.full(3, scene.led_rad))]
    start = np.array([joint.start_rad for joint in leader.arm.joints])
    lines = ["time_s," + ",".join(map(str, leader.servo_ids))]
    for row in range(round(scene.push_at_s / ROW_S)):
        at_s = row * ROW_S
        q = start + along(legs, at_s, absolute=True)[0]
        angles = leader.servo_angles(q, float(np.interp(at_s, times, closed)))
        lines.append(",".join(f"{number:.9g}" for number in (at_s, *angles)))
    return "\n".join(lines) + "\n"


def measured(
    controller: str,
    near: dict[str, npt.NDArray[Any]],
    far: dict[str, npt.NDArray[Any]],
    report: dict[str, object],
) -> FollowResult:
    """Return the result from the master's trace and the slave's recording."""
    position, velocity = near["position"], near["velocity"][:, JOINT - 1]
    force = near["device_force"][:, JOINT - 1]
    held = far["holds_object"].astype(bool)
    carried = far["position"][held]
    # The hand does not lead that joint in the direction of the push.
    pushed = np.abs(np.minimum(velocity, 0.0))
    return FollowResult(
        controller=controller,
        grips=int(np.count_nonzero(held[1:] & ~held[:-1])) + int(held[0]),
        grip_n=float(np.median(far["gripper_force"][held])) if held.any() else 0.0,
        finger_n=float(np.abs(near["trigger_device_force"]).max()),
        open_at_end=not held[-1] and float(far["gripper"][-1]) < OBJECT,
        led_rad=float((position.max(axis=0) - position[0]).min()),
        carried_rad=float((carried.max(axis=0) - carried[0]).min()) if held.any() else 0.0,
        felt_nm=float(np.abs(force).max()),
        thrown_rad_s=float(pushed.max()),
        final_state=str(report["final_state"]),
        holds=int(str(report["holds"])),
    )


def trigger_of(arm: ArmDescription) -> Trigger:
    """Return the leader's trigger; the corresponding servo moves the follower's gripper."""
    if arm.trigger is None:
        message = f"{arm.name}: must have a trigger"
        raise ValueError(message)
    return arm.trigger


def follower_file(arm: ArmDescription) -> str:
    """Return the calibration file of a follower with the servos of a description."""
    settings = arm_settings(LeaderOptions(port="", arm=arm.name), msgspec.structs.replace(arm, trigger=None))
    return calibration_text(settings.baud, settings.servos)


def scene_text(scene: FollowScene, controller: str, arm: ArmDescription, ports: tuple[str, str], file: Path) -> str:
    """Return the scene of both sides, with the device of the emulator."""
    trigger = trigger_of(arm)
    finger = JointSettings.of(trigger.servo_model)
    loads = [servo.joint.settings for servo in servos_of(arm, baud=4_000_000, firmware=52)][: len(arm.joints)]
    return SCENE.format(
        offsets=[joint.offset_rad for joint in arm.joints],
        signs=[joint.sign for joint in arm.joints],
        constants=[joint.servo_model.nominal_nm_per_a for joint in arm.joints],
        duration_s=scene.duration_s,
        axes=len(arm.joints),
        mass=[round(load.inertia, 6) for load in loads],
        viscous=[round(load.viscous, 5) for load in loads],
        coulomb=[round(load.coulomb, 5) for load in loads],
        leader=ports[0],
        arm=LEADER,
        follower=ports[1],
        file=file,
        travel=round(abs(trigger.closed_rad - trigger.open_rad) * trigger.lever_m, 6),
        finger_mass=round(finger.inertia / trigger.lever_m**2, 6),
        finger_viscous=round(finger.viscous / trigger.lever_m**2, 6),
        finger_coulomb=round(finger.coulomb / trigger.lever_m, 6),
        finger_quantum=1.5339808e-3 * trigger.lever_m,
        grip_n=GRIP_N,
        grip_id=trigger.servo,
        grip_model=trigger.model,
        grip_constant=trigger.servo_model.nominal_nm_per_a,
        open_rad=trigger.open_rad,
        closed_rad=trigger.closed_rad,
        lever=trigger.lever_m,
        controllers=[] if controller == "none" else [controller],
    ).replace("'", '"')


def draw_follow(
    scene: FollowScene, results: Sequence[FollowResult], folder: Path, path: Path, columns: Columns = 2
) -> None:
    """Draw joints and gripper of the first run, and the felt force of each run, from the files in `folder`.

    Args:
        scene: Course of the demonstration.
        results: One result per controller.
        folder: Folder with the files of the runs.
        path: Target picture, .png, .pdf or .svg.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        ValueError: The picture has another suffix.
    """
    with styled():
        title = (
            f"A follower takes something and carries it, is pushed with {scene.push_nm:g} N m,\n"
            f"and the hand lets go of the leader: {scene.delay_s * 1e3:g} ms each way, {scene.loss:.1%} loss"
        )
        figure = new_figure(columns, 5.2 if columns == 2 else 10.0, title)
        panels = figure.subplots(2, 3) if columns == 2 else figure.subplots(6, 1).reshape(2, 3)
        signals = (
            ("velocity", f"velocity, joint {JOINT} [rad/s]"),
            ("device_force", f"torque, joint {JOINT} [N m]"),
            ("position", f"angle, joint {JOINT} [rad]"),
        )
        for result in results:
            with np.load(folder / f"follow-{result.controller}.npz") as arrays:
                near = {name: arrays[name] for name in (*NEAR, "trigger", "state")}
            near_s = near["time_s"] - _begun_s(scene, near)
            for panel, (signal, label) in zip(panels[1], signals, strict=True):
                panel.plot(near_s, near[signal][:, JOINT - 1], label=controller_title(result.controller),
                           **controller_look(result.controller))  # fmt: skip
                panel.set_ylabel(label)
        first = results[0].controller
        far = read_recording(folder / f"follow-{first}.mcap").signals
        with np.load(folder / f"follow-{first}.npz") as arrays:
            near = {name: arrays[name] for name in (*NEAR, "trigger", "state")}
        near_s = near["time_s"] - _begun_s(scene, near)
        # The sides have separate clocks, but engage at the same time except for the delay.
        far_s = far["time_ns"] * 1e-9
        far_s = far_s - far_s[np.flatnonzero(np.isin(far["state"], ("engaged", "stale")))[0]]
        far_s = far_s + near_s[np.flatnonzero(near["state"] == ENGAGED)[0]]
        joints, jaws, force = panels[0]
        for index in range(near["position"].shape[1]):
            look = {"color": AXES[index % len(AXES)], "lw": 0.9}
            joints.plot(near_s, near["position"][:, index] - near["position"][0, index], label=f"{index + 1}", **look)
            joints.plot(far_s, far["position"][:, index] - far["position"][0, index], ls="--", **look)
        joints.set_ylabel("leader, follower dashed [rad]")
        jaws.plot(near_s, near["trigger"], label="trigger", color=SIGNALS["hand"])
        jaws.plot(far_s, far["gripper"], label="jaws", color=SIGNALS["arm"])
        jaws.fill_between(far_s, 0.0, 1.0, where=far["holds_object"].astype(bool).tolist(), color="#e3e6ea", lw=0.0,
                          zorder=0.5, label="holds")  # fmt: skip
        jaws.set_ylabel("gripper, 1 is closed")
        force.plot(far_s, far["gripper_force"], label="jaws", color=SIGNALS["arm"])
        force.plot(near_s, np.abs(near["trigger_device_force"]), label="finger", color=SIGNALS["hand"])
        force.set_ylabel("force [N]")
        beside = 3 if columns == 2 else 1
        for panel in panels[0]:
            legend_above(panel, width_in=figure.get_figwidth() / beside - 0.65)
        legend_beside(figure, panels[1][0].get_legend_handles_labels()[0])
        for panel in panels.flat:
            panel.set_xlabel("time since the hand begins [s]")
            panel.set_xlim(0.0, scene.duration_s)
        letter(list(panels.flat))
    write_figure(figure, path)


def _begun_s(scene: FollowScene, near: dict[str, npt.NDArray[Any]]) -> float:
    """Return the start of the hand by the master's clock; its trigger closes first."""
    return float(near["time_s"][np.flatnonzero(near["trigger"] > BEGUN)[0]]) - scene.close_at_s
