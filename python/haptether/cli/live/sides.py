"""Live sides of a scene or of options; the device is a model, or real with a driver."""

import math
import os
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from haptether.cli.interrupts import INTERRUPTS
from haptether.cli.shared.design import design_lines
from haptether.cli.shared.ejection import announcement

if TYPE_CHECKING:
    from haptether.bridge import (
        DeviceRun,
        LiveMaster,
        LiveSlave,
        MasterRun,
        Scene,
        SlaveRun,
    )
    from haptether.cli.live.check_link import CheckLink
    from haptether.cli.live.master import Controller, Master
    from haptether.cli.live.slave import Slave
    from haptether.cli.shared.stop import Stopped
    from haptether.cli.view.console import Console
    from haptether.cli.view.trial.command import Try

READY_S = 60.0
"""Time in s that a driver may take to open its device."""
OLD_START_S = 60.0
"""Age in s of a start that presses no clutch; the limit is 5 s."""
LOADED_S = time.monotonic()
"""Load time of this module, where the system does not tell when the process began."""


def live_scene(command: "Master | Slave | CheckLink | Console | Try", instead: Iterable[str]) -> "Scene | None":
    """Return the scene of a live command, if it names one; then its options `instead` must not be given.

    Raises:
        SceneError: An invalid scene.
        ValueError: Options beside it, changes without it, or a scene of one side only.
    """
    from haptether.bridge import load_scene

    if command.scene is None:
        if command.set:
            message = f"set = {command.set[0]}: changes a scene: --scene must name one"
            raise ValueError(message)
        return None
    default = {field.name: field.default for field in fields(command)}
    if given := [flag for flag in instead if getattr(command, flag) != default[flag]]:
        flags = ", ".join(f"--{flag.replace('_', '-')}" for flag in given)
        message = f"{flags}: the scene says that: change it by --set KEY=VALUE"
        raise ValueError(message)
    scene = load_scene(command.scene, command.set)
    if scene.slave is None:
        message = (
            f"scene = {command.scene}: has no [slave]: a live scene has two sides: add [slave], or take remote_push"
        )
        raise ValueError(message)
    return scene


def with_clutch(scene: "Scene", clutch: str) -> "Scene":
    """Return the scene with the clutch of the command line: no default of a scene may move an arm again after a hold.

    Raises:
        ValueError: "auto" for a scene with times of its own, or with a simulated device that nobody holds.
    """
    from haptether.bridge import override_scene

    if scene.operator is None and scene.master.driver is None and clutch == "auto":
        message = "--clutch auto: the scene has no [operator] who could press: add one, or leave it out"
        raise ValueError(message)
    if scene.operator is None or scene.operator.clutch == clutch:
        return scene
    if clutch == "open":
        return override_scene(scene, ["operator.clutch=once"])
    if not isinstance(scene.operator.clutch, str):
        if clutch == "auto":
            message = "--clutch auto: the scene has times for the clutch: change them by --set operator.clutch=auto"
            raise ValueError(message)
        return scene
    return override_scene(scene, [f"operator.clutch={clutch}"])


def start_master(
    command: "Master", scene: "Scene | None", stopped: "Stopped", arguments: dict[str, Any]
) -> "LiveMaster | MasterRun":
    """Start the master of a scene, or without one, of the command's options.

    Args:
        command: Its `clutch` is that of a real device without a button.
        scene: The result of `with_clutch`.
        stopped: Stops the loop, which is attached to it.
        arguments: The result of `live_arguments`.

    Raises:
        ValueError: No such driver or option.
        OSError: An address that cannot be used.
        KeyboardInterrupt: Ctrl-C while the device opened; it is closed.
        RuntimeError: The device did not open in time; it is closed.
    """
    from haptether.bridge import LiveMaster, MasterLoop, MasterRun, scene_json, unusual_numbers
    from haptether.bridge.devices.scene import master_driver

    arguments = {**arguments, "peer": command.peer, "started_s": started_s()}
    clutch: Literal["once", "auto"] = "auto" if command.clutch == "auto" else "once"
    if command.clutch == "open":
        # A start that is too old to be a press.
        arguments["started_s"] = max(0.0, time.monotonic() - OLD_START_S)
    if scene is None:
        scene = baseline_scene(
            controller=command.controller,
            depth=command.depth,
            release_at_s=command.release_at_s,
            force_scale=command.force_scale,
            encoder_quantum=command.encoder_quantum,
            clutch=clutch,
        )
    if scene.master.driver is not None and arguments["started_s"] is None:
        # A driver may take long to load: the start counts from here.
        arguments["started_s"] = time.monotonic()
    scene, device = master_driver(scene)
    spec = scene_json(scene)
    said = [*unusual_numbers(scene), *announcement(scene), *design_lines(scene, command.scene, command.set)]
    if device is None:
        master = stopped.attached(LiveMaster(spec, **arguments))
        _say(said)
        return master
    loop = stopped.attached(MasterLoop(spec, clutch=clutch, **arguments))
    _say(said)
    _announce(f"[master] driver = {scene.master.driver}", device)
    run = MasterRun(device, loop, period_s=scene.run.period_s)
    if command.clutch == "auto":
        message = "--clutch auto: a simulated person presses the clutch of this device: it couples anew after each hold"
        print(message, file=sys.stderr, flush=True)
    return _opened(run, device, f"[master] driver = {scene.master.driver}", stopped)


def start_slave(
    command: "Slave", scene: "Scene | None", stopped: "Stopped", arguments: dict[str, Any]
) -> "LiveSlave | SlaveRun":
    """Start the slave of a scene, or without one, of the command's options; see `start_master`."""
    from haptether.bridge import LiveSlave, SlaveLoop, SlaveRun, scene_json, unusual_numbers
    from haptether.bridge.devices.scene import slave_drivers, slave_period_s

    if scene is None:
        scene = baseline_scene(
            wall_stiffness=command.wall_stiffness,
            push_at_s=command.push_at_s,
            push_force_n=command.push_force_n,
            push_duration_s=command.push_duration_s,
        )
        for flag in ("push_force_n", "push_duration_s"):
            if command.push_at_s is None and getattr(command, flag) != getattr(type(command), flag):
                message = f"{flag} = {getattr(command, flag):g}: nothing pushes: give --push-at-s, or leave it out"
                raise ValueError(message)
    _say(unusual_numbers(scene))
    scene, device, gripper = slave_drivers(scene)
    if device is None:
        return stopped.attached(LiveSlave(scene_json(scene), **arguments))
    assert scene.slave is not None
    name = f"[slave] device = {scene.slave.device}"
    loop = stopped.attached(SlaveLoop(scene_json(scene), **arguments))
    _announce(name, device)
    return _opened(SlaveRun(device, loop, period_s=slave_period_s(scene), gripper=gripper), device, name, stopped)


def started_s() -> float | None:
    """Return when a person started this process, by `time.monotonic()`; None if the process is not the command's own.

    A process that was stopped while it loaded, or a machine that slept, does not make the start younger.
    """
    if not INTERRUPTS.begun:
        return None
    try:
        # Field 22 is in ticks since the machine started, its sleep included. The name before it may have any
        # characters.
        values = Path("/proc/self/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - int(values[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return LOADED_S
    return max(0.0, min(LOADED_S, time.monotonic() - age_s))


def _say(lines: Iterable[str]) -> None:
    for line in lines:
        print(line, file=sys.stderr, flush=True)


def _announce(name: str, device: object) -> None:
    """Announce before a device is opened that it will exert force by itself."""
    from haptether.cli.shared.own_force import exerts_by_itself

    if exerts_by_itself(device):
        message = (
            f"{name}: it exerts force by itself as soon as it is open, also before the two sides engage: one hand"
            " supports it, no fingers are between its links"
        )
        print(message, file=sys.stderr, flush=True)


Run = TypeVar("Run", bound="DeviceRun")


def _opened(run: Run, device: object, name: str, stopped: "Stopped") -> Run:
    """Wait until the device is open."""
    from haptether.cli.shared.own_force import announce_end, exerts_by_itself
    from haptether.cli.shared.screen import Screen

    end = time.monotonic() + READY_S
    with Screen(stderr=True).status(f"opening {name}   (Ctrl-C ends)"):
        while not run.ready() and not stopped and time.monotonic() < end:
            time.sleep(0.01)
        if run.ready() and not (run.finished and run.error is not None):
            return run
        late = not run.ready()
        run.give_up()
    if not run.finished and exerts_by_itself(device):
        announce_end(name, closed=False)
    if not late and run.error is not None:
        # The device was never open: there is no run to report.
        raise run.error
    if stopped:
        raise KeyboardInterrupt
    message = f"{name}: did not open within {READY_S:g} s"
    raise RuntimeError(message)


# ----------------------------------------------------------------------------------------- both sides without `--scene`

START_M = 0.02
"""First distance in m of hand and arm from the wall."""
PRESS_S = 1.2
"""Time in s in which the hand reaches its target in the wall."""
HAND_STIFFNESS = 300.0
HAND_DAMPING = 8.0
GRIP_STRENGTH_N = 12.0
RELEASE_DURATION_S = 0.05
STOPS_M = (-0.08, 0.08)
"""Mechanical stops of a PHANTOM Desktop, whose workspace is 0.16 m wide."""
PUSH_RISE_S = 0.5
RANGES: dict[str, Callable[[float], bool]] = {
    "finite": lambda _: True,
    "finite and above 0": lambda number: number > 0.0,
    "finite and 0 or more": lambda number: number >= 0.0,
    "at least 0 s": lambda number: number >= 0.0,
}
"""Permitted values of an option, by the words of its refusal."""


def baseline_scene(
    *,
    controller: "Controller" = "none",
    depth: float = 0.045,
    release_at_s: float | None = None,
    force_scale: float = 1.0,
    encoder_quantum: float = 2.3e-5,
    clutch: Literal["once", "auto"] = "once",
    wall_stiffness: float = 100.0,
    push_at_s: float | None = None,
    push_force_n: float = 3.5,
    push_duration_s: float = 2.0,
) -> "Scene":
    """Return the scene of `haptether master` and `haptether slave` without `--scene`.

    A PHANTOM Desktop is in a hand that presses `depth` m deep and lets go at `release_at_s`. A position-controlled arm
    in front of a wall at x = 0 is shoved at `push_at_s`. None means never for both times.

    Raises:
        ValueError: A parameter out of its bounds.
    """
    from haptether.bridge import (
        ContactTable,
        CouplingTable,
        EnvironmentTable,
        LegTable,
        MasterTable,
        ObjectTable,
        OperatorTable,
        PusherTable,
        ReleaseTable,
        SafetyTable,
        Scene,
        SlaveTable,
    )

    for name, value, allowed in (
        ("depth", depth, "finite"),
        ("release_at_s", release_at_s or 0.0, "at least 0 s"),
        ("force_scale (lambda_f)", force_scale, "finite and above 0"),
        ("encoder_quantum", encoder_quantum, "finite and 0 or more"),
        ("wall stiffness", wall_stiffness, "finite and 0 or more"),
        ("push time", push_at_s or 0.0, "finite"),
        ("push force", push_force_n, "finite"),
        ("push duration", push_duration_s, "finite and 0 or more"),
    ):
        if not (math.isfinite(value) and RANGES[allowed](value)):
            message = f"{name} = {'NaN' if math.isnan(value) else f'{value:g}'}: must be {allowed}"
            raise ValueError(message)
    release = None if release_at_s is None else ReleaseTable(at_s=release_at_s, decay_s=RELEASE_DURATION_S)
    push = PusherTable(
        shape="ramp", at_s=push_at_s or 0.0, force_n=push_force_n, duration_s=push_duration_s, rise_s=PUSH_RISE_S
    )
    return Scene(
        schema=1,
        master=MasterTable(device="phantom-desktop", encoder_quantum=encoder_quantum, stops=STOPS_M),
        operator=OperatorTable(
            stiffness=HAND_STIFFNESS,
            damping=HAND_DAMPING,
            grip_strength_n=GRIP_STRENGTH_N,
            start=START_M,
            legs=(LegTable(duration_s=PRESS_S, end=-depth),),
            release=release,
            clutch=clutch,
        ),
        slave=SlaveTable(),
        environment=EnvironmentTable(
            objects=(ObjectTable(contact=ContactTable(stiffness=wall_stiffness)),),
            pushers=() if push_at_s is None else (push,),
        ),
        coupling=CouplingTable(force_scale=force_scale),
        safety=SafetyTable(controllers=() if controller == "none" else (controller,)),
    )
