"""Live sides as a scene says: whose device is a model, or real with a driver."""

import os
import sys
import time
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal, TypeVar

if TYPE_CHECKING:
    from haptether.bridge import DeviceRun, LiveMaster, LiveSlave, MasterRun, Scene, SlaveRun
    from haptether.cli.live.run import Stopped
    from haptether.slave import SlaveDevice

READY_S = 60.0
"""How long a driver may take to open its device."""


def live_scene(options: Any, name: str | None, overrides: Iterable[str], instead: Iterable[str]) -> "Scene | None":  # noqa: ANN401  # a command
    """The scene of a live command, if one is named; then the flags that say the same must not be given.

    Raises:
        SceneError: A scene that cannot be.
        ValueError: Flags beside it, changes without it, or a scene of one side only.
    """
    from haptether.bridge import load_scene

    overrides = tuple(overrides)
    if name is None:
        if overrides:
            message = f"set = {overrides[0]}: changes a scene: --scene must name one"
            raise ValueError(message)
        return None
    default = {field.name: field.default for field in fields(options)}
    if given := [flag for flag in instead if getattr(options, flag) != default[flag]]:
        flags = ", ".join(f"--{flag.replace('_', '-')}" for flag in given)
        message = f"{flags}: the scene says that: change it by --set KEY=VALUE"
        raise ValueError(message)
    scene = load_scene(name, overrides)
    if scene.slave is None:
        message = f"scene = {name}: has no [slave]: a live scene has two sides"
        raise ValueError(message)
    return scene


def with_clutch(scene: "Scene", clutch: str) -> "Scene":
    """The scene with the clutch of the command line: no default of a scene may move an arm again after a hold.

    Raises:
        ValueError: "auto", where the scene has times of its own, or a simulated device that nobody holds.
    """
    from haptether.bridge import override_scene

    if scene.operator is None and scene.master.driver is None and clutch == "auto":
        message = "--clutch auto: the scene has no [operator] who could press: add one, or leave it out"
        raise ValueError(message)
    if scene.operator is None or scene.operator.clutch == clutch:
        return scene
    if not isinstance(scene.operator.clutch, str):
        if clutch == "auto":
            message = "--clutch auto: the scene has times for the clutch: change them by --set operator.clutch=auto"
            raise ValueError(message)
        return scene
    return override_scene(scene, [f"operator.clutch={clutch}"])


def start_master(
    scene: "Scene",
    stopped: "Stopped",
    *,
    clutch: Literal["once", "auto"],
    **how: Any,  # noqa: ANN401  # of LiveMaster
) -> "LiveMaster | MasterRun":
    """The master of a scene, begun; `clutch` is that of a real device without a button.

    Raises:
        ValueError: A driver or an option that there is not.
        OSError: An address that cannot be used.
        KeyboardInterrupt: Ctrl-C while the device opened; it is closed.
        RuntimeError: The device did not open in time; it is closed.
    """
    from haptether.bridge import LiveMaster, MasterLoop, MasterRun, load_master, scene_json

    spec = scene_json(scene)
    if scene.master.driver is None:
        return stopped.attached(LiveMaster(spec, **how))
    # The loop first: without a time of its own the start counts from here, and a driver may take its time to be loaded.
    loop = stopped.attached(MasterLoop(spec, clutch=clutch, **how))
    device = load_master(scene.master.driver, scene.master.options)
    run = MasterRun(device, loop, period_s=scene.run.period_s)
    if clutch == "auto":
        message = "--clutch auto: a simulated person presses the clutch of this device: it couples anew after each hold"
        print(message, file=sys.stderr, flush=True)
    return _opened(run, f"[master] driver = {scene.master.driver}", stopped)


def start_slave(scene: "Scene", stopped: "Stopped", **how: Any) -> "LiveSlave | SlaveRun":  # noqa: ANN401  # of LiveSlave
    """The slave of a scene, begun.

    Raises:
        ValueError: A driver or an option that there is not.
        OSError: An address that cannot be used.
        KeyboardInterrupt: Ctrl-C while the device opened; it is closed.
        RuntimeError: The device did not open in time; it is closed.
    """
    from haptether.bridge import LiveSlave, SlaveLoop, SlaveRun, load_slave, scene_json

    assert scene.slave is not None
    if scene.slave.device == "simulated":
        return stopped.attached(LiveSlave(scene_json(scene), **how))
    device = load_slave(scene.slave.device, scene.slave.options)
    spec = scene_json(_within(scene, device))
    period_s = scene.run.period_s if scene.slave.period_s is None else scene.slave.period_s
    loop = stopped.attached(SlaveLoop(spec, **how))
    return _opened(SlaveRun(device, loop, period_s=period_s), f"[slave] device = {scene.slave.device}", stopped)


def _within(scene: "Scene", device: "SlaveDevice") -> "Scene":
    """The scene, whose commands are no faster than the arm may follow: else it would go on after it was let go."""
    from haptether.bridge import override_scene

    axes = getattr(device, "axes", None)
    if axes is not None and axes != scene.master.axes:
        message = f"slave.options: the arm has {axes} axes, the scene {scene.master.axes}: must be as many"
        raise ValueError(message)
    most = getattr(device, "max_speed", None)
    if most is None or (scene.coupling is not None and _speed(scene.coupling.command_speed) <= most):
        return scene
    return override_scene(scene, [f"coupling.command_speed={most}"])


def _speed(bound: object) -> float:
    return float(bound) if isinstance(bound, int | float) else float("inf")


Run = TypeVar("Run", bound="DeviceRun")


def _opened(run: Run, name: str, stopped: "Stopped") -> Run:
    """Waits until the device is open."""
    from haptether.cli.shared.queued_output import deliver_output
    from haptether.cli.shared.screen import Screen

    end = time.monotonic() + READY_S
    with Screen(stderr=True).status(f"opening {name}   (Ctrl-C ends)"):
        while not run.ready() and not stopped and time.monotonic() < end:
            time.sleep(0.01)
        if run.ready() and not (run.finished and run.error is not None):
            return run
        late = not run.ready()
        run.give_up()
    if not late and run.error is not None:
        # It was never open: there is nothing to say of a run.
        raise run.error
    if stopped:
        if not run.finished:
            # Threads of a vendor's library that still connects would end an orderly exit with an abort.
            deliver_output()
            os._exit(130)
        raise KeyboardInterrupt
    message = f"{name}: did not open within {READY_S:g} s"
    raise RuntimeError(message)


def fault_text(run: "LiveMaster | LiveSlave | DeviceRun") -> str:
    """What the line of a run says of a device that has failed, or nothing."""
    from haptether.bridge import DeviceRun
    from haptether.printable import printable

    return f", {printable(run.notes.fault)}" if isinstance(run, DeviceRun) and run.notes.fault is not None else ""


def raise_error(run: "LiveMaster | LiveSlave | DeviceRun") -> None:
    """Raises what ended the loop of a driver, if anything did."""
    from haptether.bridge import DeviceRun

    if isinstance(run, DeviceRun) and run.error is not None:
        raise run.error
