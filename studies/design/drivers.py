"""The drivers of a scene, held against their options and the scene as at a live start, without opening a device."""

from collections.abc import Callable

from haptether.bridge import Scene
from haptether.bridge.devices.open import DeviceError, attach_gripper
from haptether.bridge.devices.scene import master_driver, slave_drivers
from haptether.bridge.scene.tables.slave import SIMULATED
from haptether.studies.design.finding import Finding


def with_drivers(scene: Scene) -> tuple[Scene, tuple[Finding, ...]]:
    """The scene with the bounds of its drivers, and a finding for each side of a scene that names a driver."""
    master, slave = scene.master.driver, scene.slave
    jaws = None if slave is None else slave.gripper
    devices = [] if slave is None else [slave.device] if jaws is None else [slave.device, jaws.device]
    arms = [name for name in devices if name != SIMULATED]
    findings = []
    if master is not None:
        scene, finding = _judged(scene, "master driver", [master], _with_master)
        findings.append(finding)
    if arms or (master is not None and slave is None):
        scene, finding = _judged(scene, "slave driver", arms, _with_slave)
        findings.append(finding)
    return scene, tuple(findings)


def _with_master(scene: Scene) -> tuple[Scene, object]:
    return master_driver(scene)


def _with_slave(scene: Scene) -> tuple[Scene, object]:
    scene, arm, gripper = slave_drivers(scene)
    if arm is not None and gripper is not None:
        attach_gripper(gripper, arm)
    return scene, arm


def _judged(
    scene: Scene, name: str, drivers: list[str], with_bounds: Callable[[Scene], tuple[Scene, object]]
) -> tuple[Scene, Finding]:
    try:
        changed, device = with_bounds(scene)
    except (ValueError, DeviceError) as error:
        said = error.brief if isinstance(error, DeviceError) else str(error)
        return scene, Finding(name=name, state="bad", text=" ".join(said.split()))
    names = " and ".join(drivers)
    text = f"{names} can be in this scene, with these options; no device was opened: `haptether check-device NAME` does"
    if getattr(device, "paces", False) and getattr(device, "period_s", None) is None:
        text += ", and shows the period by which it paces the loop: the scene must have the same"
    return changed, Finding(name=name, state="good", text=text)
