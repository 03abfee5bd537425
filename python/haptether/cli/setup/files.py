"""Files of an installation: scene, key, start scripts, and emulators."""

import contextlib
import shlex
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from haptether.cli.setup.questions import NONE, SERVOS, SIMULATED, Answers, emulates, is_local, kind_of

if TYPE_CHECKING:
    from haptether.bridge import Scene

SCENE, KEY, ANSWERS = "scene.toml", "arm.key", "setup.json"
SLAVE, MASTER, EMULATORS = "start-slave.sh", "start-master.sh", "start-emulators.sh"
LEADER_PORT, FOLLOWER_PORT, FOLLOWER_FILE = "leader.port", "follower.port", "follower.toml"
LEADER = "gello-ur"
"""Bundled description of a leader arm."""
SERVO_PERIOD_S = 0.004
UR_PERIOD_S = 0.002
SLOW = {"timeout_s": 0.1, "watchdog_s": 0.5}
"""Options of emulated servos: their processes share this machine."""
MASTER_NUMBERS: dict[str, dict[str, Any]] = {"inverse3": {"device": "inverse3"}, "touch": {"device": "touch"}}
"""Presets of devices; others need `haptether identify`."""
PLACEHOLDER_KG = 0.157
"""Mass of a device without a preset, until `haptether identify` has measured it."""
JOINT_KG_M2 = 0.02
HEAD = """#!/bin/sh
# {what}
# Written by `haptether setup`.
cd "$(dirname "$0")" || exit 1
PATH="$PATH:{bin}"
export PATH
"""
ASK = """if ! [ -t 0 ]; then
    echo "{name}: a person presses the clutch: run it on a terminal" >&2
    exit 2
fi
printf 'Hold the device. Enter presses the clutch: the arm then follows the hand. ' >&2
read -r pressed || exit 2
# No exec: the age of the press is that of the new process.
"""


class Kept(msgspec.Struct, frozen=True, kw_only=True):
    """Content of `setup.json`."""

    answers: Answers

    def __post_init__(self) -> None:
        """Refuse answers that are missing."""
        if missing := {"master", "arm", "gripper", "address"} - self.answers.keys():
            message = f"answers: {', '.join(sorted(missing))} is missing"
            raise ValueError(message)


def scene_of(answers: Answers, options: dict[str, dict[str, Any]], folder: Path) -> "Scene":
    """Return the checked scene of the answers.

    Args:
        answers: Answers of a person.
        options: Further options of the drivers, by "master", "arm" and "gripper".
        folder: Folder of the files, absolute.

    Raises:
        SceneError: The answers give no valid scene.
    """
    from haptether.bridge.scene.load import checked

    kind = kind_of(answers)
    slave = _slave(answers, options, folder)
    master = _master(answers, kind, options["master"], folder)
    raw: dict[str, Any] = {
        "schema": 1,
        "title": f"{answers['master']} leads {answers['arm']}",
        "master": master,
        # For checks and virtual time also where a person holds a real device.
        "operator": _hand(kind, master["axes"]),
        "slave": slave,
        "safety": {"controllers": ["wsc"]},
    }
    if SERVOS in {answers["master"], answers["arm"]}:
        raw["run"] = {"period_s": SERVO_PERIOD_S}
    if "gripper" in slave:
        raw["operator"]["trigger"] = [[2.0, 0.0], [3.0, 1.0], [6.0, 1.0], [7.0, 0.0]]
    return checked(raw, folder).scene


def check_drivers(answers: Answers, options: dict[str, dict[str, Any]]) -> None:
    """Check the options of the drivers at this end, before anything is written.

    Raises:
        ValueError: A driver is unknown or refuses an option.
    """
    from haptether.bridge.devices.open import DeviceError
    from haptether.bridge.devices.scene import master_driver, slave_drivers

    end = answers.get("end", "both")
    with tempfile.TemporaryDirectory() as draft:
        scene = scene_of(answers, options, Path(draft))
        if emulates(answers) and answers["arm"] == SERVOS:
            (Path(draft) / FOLLOWER_FILE).write_text(_follower_text())
        for check, other in ((master_driver, "slave"), (slave_drivers, "master")):
            # The check of the written scene names the remedy of any other error.
            with contextlib.suppress(DeviceError):
                if end != other:
                    check(scene)


def _master(answers: Answers, kind: str, further: dict[str, Any], folder: Path) -> dict[str, Any]:
    name = answers["master"]
    if name == SIMULATED and kind == "linear":
        return {"device": "phantom-desktop", "axes": 3}
    if name == SIMULATED:
        axes = len(_follower(answers, folder)[1])
        return {"kind": kind, "axes": axes, "mass_kg": JOINT_KG_M2, "friction": "axis"}
    own: dict[str, Any]
    if name != SERVOS:
        own = {"host": answers["master_address"]} if "master_address" in answers else {}
        numbers = MASTER_NUMBERS.get(name, {"mass_kg": PLACEHOLDER_KG})
        return {**numbers, "driver": name, "axes": 3, "options": {**own, **further}}
    arm = further.get("arm", LEADER)
    own = {"arm": arm, "kind": kind}
    numbers = {"mass_kg": JOINT_KG_M2}
    if emulates(answers):
        unit, numbers = _emulated_unit(arm)
        own |= {"port": str(folder / LEADER_PORT), **unit, **SLOW}
    else:
        own |= {"port": answers["master_address"], "calibration": str(Path(answers["master_file"]).resolve())}
    table: dict[str, Any] = {"kind": kind, "driver": SERVOS, "options": {**own, **further}}
    if kind == "joints":
        return table | {"axes": _joints(arm), "friction": "axis", **numbers}
    table |= {"axes": 3, "mass_kg": PLACEHOLDER_KG, "rotation": {"inertia_kg_m2": [4e-4] * 3}}
    return table | (_emulated_pose(arm) if emulates(answers) else {})


def _slave(answers: Answers, options: dict[str, dict[str, Any]], folder: Path) -> dict[str, Any]:
    name, further = answers["arm"], options["arm"]
    slave: dict[str, Any] = {}
    own: dict[str, Any]
    if name == "ur":
        own = {"host": answers["arm_address"], "axes": 3}
        slave = {"device": name, "period_s": UR_PERIOD_S, "options": {**own, **further}}
    elif name == SERVOS:
        port = str(folder / FOLLOWER_PORT) if emulates(answers) else answers["arm_address"]
        own = {"port": port, "arm": str(_follower(answers, folder)[0]), **(SLOW if emulates(answers) else {})}
        slave = {"device": name, "period_s": SERVO_PERIOD_S, "options": {**own, **further}}
    elif name != SIMULATED:
        slave = {"device": name, "options": further}
    if kind_of(answers) == "pose":
        # The model of the tool, for virtual time.
        slave |= {
            "control": "pd",
            "stiffness": 4000.0,
            "tool": {"inertia_kg_m2": [0.02] * 3, "rotational_stiffness": 40.0},
        }
    gripper = answers["gripper"]
    if gripper == SIMULATED:
        slave["gripper"] = {}
    elif gripper != NONE:
        own = {"host": answers["gripper_address"]} if "gripper_address" in answers else {}
        slave["gripper"] = {"device": gripper, "options": {**own, **options["gripper"]}}
    return slave


def _hand(kind: str, axes: int) -> dict[str, Any]:
    """Return a simulated hand that moves along each axis and back."""
    if kind != "joints":
        ends = [[0.02 if axis == at else 0.0 for axis in range(axes)] for at in range(axes)]
        hand: dict[str, Any] = {"stiffness": 300.0, "damping": 20.0, "grip_strength_n": 12.0}
    else:
        ends = [[0.1 if axis == at else 0.0 for axis in range(axes)] for at in range(axes)]
        hand = {"stiffness": 5.0, "damping": 0.1}
    if kind == "pose":
        hand["rotation"] = {}
    return {**hand, "legs": [{"duration_s": 2.0, "end": end} for end in (*ends, [0.0] * axes)]}


def _emulated_unit(arm: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the options and the numbers of an emulated leader, which is as it is described and has no weight."""
    from haptether.dynamixel.description import load_arm
    from haptether.dynamixel.emulator import servos_of

    description = load_arm(arm)
    joints = description.joints
    loads = [servo.joint.settings for servo in servos_of(description, baud=4_000_000, firmware=52)][: len(joints)]
    options = {
        "offsets": [joint.offset_rad for joint in joints],
        "signs": [joint.sign for joint in joints],
        "torque_constant": [joint.servo_model.nominal_nm_per_a for joint in joints],
        "gravity_gain": 0.0,
    }
    names = {"mass_kg": "inertia", "viscous": "viscous", "coulomb": "coulomb"}
    return options, {key: [round(getattr(load, name), 6) for load in loads] for key, name in names.items()}


def _emulated_pose(arm: str) -> dict[str, Any]:
    """Return mass and inertia at the grip of an emulated leader."""
    from haptether.dynamixel.description import load_arm
    from haptether.master.dynamixel import pose_model

    own = _emulated_unit(arm)[1]["mass_kg"]
    model = pose_model(load_arm(arm), inertia=own)
    return {
        "mass_kg": [round(mass, 4) for mass in model.mass_kg],
        "rotation": {"inertia_kg_m2": [round(inertia, 7) for inertia in model.inertia_kg_m2]},
    }


def _joints(arm: str) -> int:
    from haptether.dynamixel.description import load_arm

    return len(load_arm(arm).joints)


def _follower(answers: Answers, folder: Path) -> tuple[Path, list[Any]]:
    """Return the file of the follower and its servos."""
    import tomllib

    if emulates(answers):
        return folder / FOLLOWER_FILE, tomllib.loads(_follower_text())["servo"]
    path = Path(answers["arm_file"]).resolve()
    return path, tomllib.loads(path.read_text(encoding="utf-8")).get("servo", [])


def _follower_text() -> str:
    from haptether.dynamixel.description import load_arm
    from haptether.studies.follow import follower_file

    return follower_file(load_arm(LEADER))


def write_files(answers: Answers, scene: "Scene", options: dict[str, dict[str, Any]], folder: Path) -> list[Path]:
    """Write all files and return their paths; the folder is empty or new.

    Raises:
        OSError: A file cannot be written.
    """
    from haptether.bridge import save_scene, write_key
    from haptether.private_file import write_private

    folder.mkdir(parents=True, exist_ok=True)
    save_scene(scene, folder / SCENE, "Written by `haptether setup`. docs/scenes.md has the tables.")
    write_key(folder / KEY)
    kept = msgspec.json.format(msgspec.json.encode(Kept(answers=answers)))
    write_private(folder / ANSWERS, kept + b"\n")
    scripts = {SLAVE: _slave_script(answers), MASTER: _master_script(answers)}
    if emulates(answers):
        scripts[EMULATORS] = _emulator_script(answers, options)
        if answers["arm"] == SERVOS:
            write_private(folder / FOLLOWER_FILE, _follower_text().encode())
    for name, text in scripts.items():
        write_private(folder / name, text.encode())
        (folder / name).chmod(0o700)
    return sorted(path for path in folder.iterdir() if path.is_file())


def _head(what: str) -> str:
    return HEAD.format(what=what, bin=shlex.quote(str(Path(sys.executable).parent)))


def _slave_script(answers: Answers) -> str:
    address = answers["address"]
    port = address.rpartition(":")[2]
    listen = address if is_local(address) else f"[::]:{port}" if address.startswith("[") else f"0.0.0.0:{port}"
    what = "The side of the arm. Ctrl-C ends it. The arm moves only after a press at the side of the hand."
    return f'{_head(what)}exec haptether slave --scene {SCENE} --listen {listen} --key {KEY} "$@"\n'


def _master_script(answers: Answers) -> str:
    what = "The side of the hand. Ctrl-C ends it. Enter on the terminal presses the clutch."
    run = f'haptether master --scene {SCENE} --peer {answers["address"]} --key {KEY} "$@"\n'
    return _head(what) + ASK.format(name=MASTER) + run


def _emulator_script(answers: Answers, options: dict[str, dict[str, Any]]) -> str:
    commands = []
    if answers["arm"] == "ur":
        ur = ["haptether", "ur-emulator", "--host", answers["arm_address"]]
        if "model" in options["arm"]:
            ur += ["--model", str(options["arm"]["model"])]
        if answers["gripper"] == "robotiq":
            ur += [
                "--gripper",
                str(options["gripper"].get("model", "2f-85")),
                "--gripper-active",
                "--gripper-object-mm",
                "40",
            ]
        commands.append(shlex.join(ur))
    servos = f"haptether dynamixel-emulator --arm {LEADER} --mass-scale 0 --socket"
    if answers["master"] == SERVOS:
        commands.append(f"{servos} {LEADER_PORT}")
    if answers["arm"] == SERVOS:
        commands.append(f"{servos} {FOLLOWER_PORT}")
    if answers["master"] == "inverse3":
        commands.append("haptether inverse3-emulator")
    started = "".join(f'{command} &\nstarted="$started $!"\n' for command in commands)
    # The trap ends only what this script started.
    return (
        _head("The emulators of the devices. Ctrl-C ends them.")
        + "started=\nend() { kill $started 2>/dev/null; }\ntrap end EXIT\ntrap 'exit 130' INT\ntrap 'exit 143' TERM\n"
        + f"{started}wait\n"
    )
