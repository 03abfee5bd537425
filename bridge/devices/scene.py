"""Create the drivers of a scene and check them against it, without opening one."""

from typing import TYPE_CHECKING, Literal

from haptether.bridge.devices.find import load_gripper, load_master, load_slave
from haptether.bridge.devices.open import check_force, check_kind, check_period, check_trigger
from haptether.bridge.scene.load import override_scene
from haptether.bridge.scene.resolve import side_kind
from haptether.bridge.scene.tables.session import CouplingTable, Scene
from haptether.bridge.scene.tables.slave import SIMULATED

if TYPE_CHECKING:
    from haptether.master import MasterDevice
    from haptether.slave import Gripper, SlaveDevice


def master_driver(scene: Scene) -> "tuple[Scene, MasterDevice | None]":
    """Return the scene with the speed bound of the master's driver, and the driver; None for a model.

    Raises:
        ValueError: The driver is unknown, refuses its options, or has another number of axes than the scene.
        DeviceError: The driver does not fit the scene, or its constructor failed.
    """
    if scene.master.driver is None:
        return scene, None
    device = load_master(scene.master.driver, scene.master.options)
    check_kind(device, side_kind(scene.master))
    check_trigger(device, is_felt=scene.master.gripper is not None)
    check_period(device, "[run] period_s", scene.run.period_s)
    _check_axes(scene, device, "master")
    return _bounded(scene, device, "master"), device


def slave_drivers(scene: Scene) -> "tuple[Scene, SlaveDevice | None, Gripper | None]":
    """Return the scene with the speed limits of the arm's driver, the driver and that of the gripper; None for models.

    Raises:
        ValueError: As `master_driver`; or the scene has no slave, or a model beside a driver.
        DeviceError: As `master_driver`.
    """
    table = scene.slave
    if table is None:
        message = "the scene has no [slave]: a live scene has two sides: add [slave]"
        raise ValueError(message)
    jaws = table.gripper
    is_driven = jaws is not None and jaws.device != SIMULATED
    if table.device == SIMULATED:
        if jaws is not None and is_driven:
            message = f"[slave.gripper] device = {jaws.device}: [slave] device must name the driver of its arm, too"
            raise ValueError(message)
        return scene, None, None
    if jaws is not None and not is_driven:
        message = (
            "[slave.gripper] device = simulated: beside an arm with a driver it must name one, too, or be left out"
        )
        raise ValueError(message)
    device = load_slave(table.device, table.options)
    gripper = None if jaws is None else load_gripper(jaws.device, jaws.options)
    check_kind(device, side_kind(scene.master))
    check_period(device, "[slave] period_s", slave_period_s(scene))
    check_force(device, takes_force=table.takes_force)
    _check_axes(scene, device, "slave")
    scene = _no_stronger(_no_faster(scene, device), device)
    return _bounded(scene, device, "slave"), device, gripper


def slave_period_s(scene: Scene) -> float:
    """Return the period of the slave's loop in s; the default is the period of the run."""
    own_s = None if scene.slave is None else scene.slave.period_s
    return scene.run.period_s if own_s is None else own_s


def _check_axes(scene: Scene, device: "MasterDevice | SlaveDevice", side: Literal["master", "slave"]) -> None:
    """Refuse a device that has another number of axes than the scene."""
    axes = getattr(device, "axes", None)
    if axes is not None and axes != scene.master.axes:
        kind = "device" if side == "master" else "arm"
        options = getattr(device, "options", None)
        key = next((key for key in ("axes", "arm") if hasattr(options, key)), None)
        message = (
            f"{side}.options: the {kind} has {axes} axes, the scene {scene.master.axes}: must be as many;"
            f" set axes = {axes} in [master], or "
            + (f"another `{key}` in [{side}.options]" if key is not None else f"take another driver in [{side}]")
        )
        raise ValueError(message)


def _no_faster(scene: Scene, device: "SlaveDevice") -> Scene:
    """Return the scene with commands no faster than the arm. A faster command leaves the arm behind, still moving."""
    coupling = scene.coupling or CouplingTable()
    slower = []
    for key, bound in (("command_speed", "max_speed"), ("command_angular_speed", "max_angular_speed")):
        most, now = getattr(device, bound, None), getattr(coupling, key)
        if most is not None and (now if isinstance(now, int | float) else float("inf")) > most:
            slower.append(f"coupling.{key}={most}")
    return override_scene(scene, slower) if slower else scene


def _no_stronger(scene: Scene, device: "SlaveDevice") -> Scene:
    """Return the scene with forces no larger than the arm exerts: a force that was cut would count as energy."""
    table = scene.slave
    if table is None or not table.takes_force:
        return scene
    weaker = []
    for key, bound in (("max_force_n", "max_force"), ("max_torque_nm", "max_torque")):
        most, now = getattr(device, bound, None), getattr(table, key)
        if most is not None and (now is None or now > most):
            weaker.append(f"slave.{key}={most}")
    return override_scene(scene, weaker) if weaker else scene


def _bounded(scene: Scene, device: object, side: Literal["master", "slave"]) -> Scene:
    """Return the scene with the speed bound of the driver, if the scene has none."""
    bound: float | None = getattr(device, "speed_bound", None)
    if bound is None or getattr(getattr(scene, side), "speed_bound", None) is not None:
        return scene
    return override_scene(scene, [f"{side}.speed_bound={bound}"])
