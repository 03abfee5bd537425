"""The demonstration of two arms of servos: a hand leads one, something pushes the other, and the hand lets go."""

import contextlib
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge import write_key
from haptether.dynamixel.arm import calibration_text
from haptether.dynamixel.description import ArmDescription
from haptether.dynamixel.emulator import servos_of
from haptether.master.dynamixel.options import LeaderOptions, arm_settings
from haptether.private_file import private_file
from haptether.studies.demo import END_TIMEOUT_S, START_TIMEOUT_S, Interrupted, Process, StopRequest, child_process
from haptether.studies.leader import HAND, LEADER, Leader, emulated_arm

FOLLOW_CONTROLLERS: Final = ("none", "hsc", "wsc")
JOINT: Final = 2
"""That is led and pushed, counted from 1."""
SIGNALS: Final = {
    "velocity": "velocity [rad/s]",
    "device_force": "reflected torque [N m]",
    "position": "angle [rad]",
}
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
options = {{ port = "{leader}", arm = "{arm}", timeout_s = 0.1, watchdog_s = 0.5 }}

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

[safety]
controllers = {controllers}
velocity_threshold = 1.0     # rad/s
hsc_force_threshold_n = 0.1  # N m
hold_off_s = 0.1
release_ramp_s = 0.2
"""


class FollowScene(msgspec.Struct, frozen=True, kw_only=True):
    """How the demonstration goes. Times in s since the hand begins."""

    delay_s: float = 0.02
    jitter_s: float = 0.001
    loss: float = 0.01
    seed: int = 1
    settle_s: float = 2.5
    """From the start of the master on: its checklist, and until its torque has risen."""
    led_rad: float = 0.3
    """How far the hand leads the joint, in 1 s."""
    push_at_s: float = 1.5
    push_nm: float = 0.5
    release_at_s: float = 2.3
    push_ends_s: float = 2.8
    duration_s: float = 3.5


class FollowResult(msgspec.Struct, frozen=True, kw_only=True):
    """What happened at the leader and at the follower, in rad, rad/s and N m."""

    controller: str
    led_rad: float
    """How far the leader's joint was led."""
    followed_rad: float
    """How far that of the follower came, before the push."""
    felt_nm: float
    """Greatest reflected torque at the joint while the hand held it."""
    thrown_rad_s: float
    """Fastest that the joint moved after the hand had let go."""
    final_state: str
    holds: int


def run_follow(
    scene: FollowScene, controller: str, folder: Path, show: Callable[[str, float], None], stopped: StopRequest
) -> FollowResult:
    """Runs both arms, the network and both sides once; arguments as of `run_demo`.

    Raises:
        Interrupted: A stop was requested; all processes have ended.
        RuntimeError: A process failed; the message holds what it said.
    """
    local, lasts_s = "127.0.0.1:0", scene.settle_s + scene.duration_s + 1.0
    limit = str(lasts_s + START_TIMEOUT_S + END_TIMEOUT_S)
    trace, result = folder / f"follow-{controller}.npz", folder / f"follow-{controller}.json"
    with contextlib.ExitStack() as stack:
        show(f"{controller}: starting", 0.0)
        private = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        key, file, text = private / "demo.key", private / "follower.toml", private / "scene.toml"
        write_key(key)
        leader = emulated_arm(limit, stack, stopped)
        # A driver of a follower does not know the weight of its arm, which would be felt as a load: it has none here.
        follower = emulated_arm(limit, stack, stopped, "--mass-scale", "0")
        leader.hold()
        file.write_text(follower_file(leader.arm), encoding="utf-8")
        text.write_text(scene_text(scene, controller, leader.arm, (leader.port, follower.port), file), encoding="utf-8")
        slave = stack.enter_context(child_process(
            "slave", "--scene", str(text), "--listen", local, "--key", str(key), "--duration-s", limit,
            "--patience-s", limit,
        ))  # fmt: skip
        slave_address = slave.headline(stopped).rsplit(" ", 1)[-1]
        netsim = stack.enter_context(child_process(
            "netsim", "proxy", "--listen", local, "--forward", slave_address, "--delay-s", str(scene.delay_s),
            "--jitter-s", str(scene.jitter_s), "--loss", str(scene.loss), "--seed", str(scene.seed),
            "--duration-s", limit,
        ))  # fmt: skip
        netsim_address = netsim.headline(stopped).split(",")[0].rsplit(" ", 1)[-1]
        master = stack.enter_context(child_process(
            "master", "--scene", str(text), "--peer", netsim_address, "--listen", local, "--key", str(key),
            "--duration-s", str(lasts_s), "--trace", str(trace), "--json", str(result),
        ))  # fmt: skip
        master.headline(stopped)
        stopped.sleep(scene.settle_s)
        followed = _play(
            scene, master, (leader, follower), lambda stage, at_s: show(f"{controller}: {stage}", at_s), stopped
        )
        if stopped:
            raise Interrupted
        if master.process.returncode != 0 or followed is None:
            message = f"the master ended with status {master.process.returncode}: {master.last()}; {slave.last()}"
            raise RuntimeError(message)
    report = msgspec.json.decode(result.read_bytes())
    with np.load(trace) as arrays:
        signals = {name: arrays[name] for name in ("time_s", "position", "velocity", "device_force")}
    return measured(controller, signals, followed, report)


def _play(
    scene: FollowScene, master: Process, arms: tuple[Leader, Leader],
    show: Callable[[str, float], None], stopped: StopRequest,
) -> float | None:  # fmt: skip
    """Has the hand lead and let go, and something push, until the master ends; how far the follower came before."""
    leader, follower = arms
    joint = leader.arm.joints[JOINT - 1]
    goal = joint.sign * (joint.start_rad + scene.led_rad) + joint.offset_rad
    push = -joint.sign * scene.push_nm
    events = [
        (0.0, "the hand leads", leader, f"hand {joint.servo} {goal} {HAND[JOINT - 1]} 1.0 1.0"),
        (scene.push_at_s, "the follower is pushed", follower, f"push {joint.servo} {push}"),
        (scene.release_at_s, "the hand has let go", leader, f"hand {joint.servo} off"),
        (scene.push_ends_s, "the push has ended", follower, f"push {joint.servo} 0"),
    ]
    stage, followed, begun_s = "", None, time.monotonic()
    while master.process.poll() is None and not stopped:
        at_s = time.monotonic() - begun_s
        if events and at_s >= events[0][0]:
            _, stage, arm, line = events.pop(0)
            if arm is follower and followed is None:
                q = _angle(follower.emulated.say("status"), joint.servo, joint.sign, joint.offset_rad)
                followed = q - joint.start_rad
            arm.emulated.say(line)
        show(stage, min(at_s, scene.duration_s))
        if at_s > scene.duration_s + START_TIMEOUT_S:
            message = f"the master did not end within {scene.duration_s + START_TIMEOUT_S:g} s"
            raise RuntimeError(message)
        stopped.sleep(0.01)
    return followed if not events else None


def measured(
    controller: str,
    signals: dict[str, npt.NDArray[np.float64]],
    followed_rad: float,
    report: dict[str, object],
) -> FollowResult:
    """What a run shows, from the trace of the master and how far the follower came."""
    position, velocity = signals["position"][:, JOINT - 1], signals["velocity"][:, JOINT - 1]
    force = signals["device_force"][:, JOINT - 1]
    # The hand that holds leads at 0.56 rad/s at most, in the other direction than the push.
    pushed = np.abs(np.minimum(velocity, 0.0))
    return FollowResult(
        controller=controller,
        led_rad=float(position.max() - position[0]),
        followed_rad=followed_rad,
        felt_nm=float(np.abs(force).max()),
        thrown_rad_s=float(pushed.max()),
        final_state=str(report["final_state"]),
        holds=int(str(report["holds"])),
    )


def follower_file(arm: ArmDescription) -> str:
    """The file of a follower with the servos of a description."""
    settings = arm_settings(LeaderOptions(port="", arm=arm.name), msgspec.structs.replace(arm, trigger=None))
    return calibration_text(settings.baud, settings.servos)


def scene_text(scene: FollowScene, controller: str, arm: ArmDescription, ports: tuple[str, str], file: Path) -> str:
    """The scene of both sides; the device is that which the emulator has."""
    loads = [servo.joint.settings for servo in servos_of(arm, baud=4_000_000, firmware=52)][: len(arm.joints)]
    return SCENE.format(
        duration_s=scene.duration_s,
        axes=len(arm.joints),
        mass=[round(load.inertia, 6) for load in loads],
        viscous=[round(load.viscous, 5) for load in loads],
        coulomb=[round(load.coulomb, 5) for load in loads],
        leader=ports[0],
        arm=LEADER,
        follower=ports[1],
        file=file,
        controllers=[] if controller == "none" else [controller],
    ).replace("'", '"')


def _angle(status: str, servo_id: int, sign: int, offset_rad: float) -> float:
    for servo in msgspec.json.decode(status)["servos"]:
        if servo["id"] == servo_id:
            return sign * (float(servo["position_rad"]) - offset_rad)
    message = f"no servo {servo_id}"
    raise RuntimeError(message)


def draw_follow(scene: FollowScene, results: Sequence[FollowResult], path: Path) -> None:
    """Draws velocity, reflected torque and angle of the leader's joint, whose traces lie beside `path`.

    Raises:
        ImportError: matplotlib is not there; it comes with `haptether[analysis]`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.2), layout="constrained")
    figure.suptitle(
        f"An emulated follower is pushed with {scene.push_nm:g} N m, and the hand lets go of an emulated leader; "
        f"{scene.delay_s * 1e3:g} ms each way, {scene.loss:.1%} loss"
    )
    panels = figure.subplots(1, 3)
    names = {"none": "no controller", "hsc": "HSC", "wsc": "WSC"}
    for result in results:
        with np.load(path.parent / f"follow-{result.controller}.npz") as arrays:
            for panel, (signal, label) in zip(
                panels,
                (
                    ("velocity", "velocity [rad/s]"),
                    ("device_force", "reflected torque [N m]"),
                    ("position", "angle [rad]"),
                ),
                strict=True,
            ):
                panel.plot(arrays["time_s"], arrays[signal][:, JOINT - 1], label=names[result.controller], lw=1.3)
                panel.set_ylabel(label)
                panel.set_xlabel("time [s]")
                panel.grid(visible=True, alpha=0.3)
    panels[0].legend(fontsize=9)
    with private_file(path) as target:
        figure.savefig(target, dpi=120)
