"""Preflight of an installation: key, scene, link, arm, gripper and haptic device."""

import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from haptether.cli.setup.files import EMULATORS, JOINT_KG_M2, KEY, PLACEHOLDER_KG, SCENE, SLAVE
from haptether.cli.setup.questions import NONE, SERVOS, SIMULATED, Answers, emulates, is_local

if TYPE_CHECKING:
    from haptether.bridge import Scene

PORTS = {"ur": 30004, "robotiq": 63352, "inverse3": 10001}
"""TCP port by which a device is found."""
PROBE_S = 2.0
CHECK_S = 2.0
"""Duration in s of the check of a device or of the link."""
COMMAND_S = 180.0
"""Largest duration in s of a check, with the answer of a person."""


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one check."""

    name: str
    state: Literal["ok", "missing", "mend"]
    """Good; not there yet; or wrong."""
    text: str
    remedy: str = ""


def preflight(answers: Answers, folder: Path, *, is_new: bool) -> Iterator[Item]:
    """Yield the results of all checks that apply at this end.

    Args:
        answers: Answers of a person.
        folder: Folder of the files.
        is_new: True for a new key, which no slave can have yet: the link is not measured.
    """
    from haptether.bridge import load_scene

    end = answers.get("end", "both")
    yield _key(folder / KEY, answers)
    scene = load_scene(folder / SCENE)
    yield from _scene(scene, folder)
    link = _link(answers, folder, is_new=is_new) if end != "slave" else None
    # A device that a running slave uses is not opened a second time.
    in_use = link is not None and link.state != "missing"
    slave = scene.slave
    assert slave is not None
    if end != "master":
        yield _device("arm", "slave", slave.device, slave.options, in_use=in_use, answers=answers, folder=folder)
        if slave.gripper is not None and slave.gripper.device != SERVOS:
            jaws = slave.gripper
            yield _device(
                "gripper", "gripper", jaws.device, jaws.options, in_use=in_use, answers=answers, folder=folder
            )
    if end != "slave":
        yield from _model(scene, answers)
        driver = scene.master.driver or SIMULATED
        yield _device("master", "master", driver, scene.master.options, in_use=False, answers=answers, folder=folder)
    if link is not None:
        yield link


def _shown(path: Path) -> str:
    return shlex.quote(str(path))


def _again(folder: Path) -> str:
    return f"haptether setup {_shown(folder)} --check"


def _key(path: Path, answers: Answers) -> Item:
    from haptether.bridge import read_key, wipe_key

    try:
        wipe_key(read_key(path))
    except (OSError, ValueError) as error:
        return Item(
            name="key", state="mend", text=str(error), remedy=f"haptether keygen {_shown(path)} --force, at one end"
        )
    other = "" if is_local(answers["address"]) else "; the other machine needs this folder too: copy it by scp -rp"
    return Item(name="key", state="ok", text=f"{path}, readable by its owner only{other}")


def _scene(scene: "Scene", folder: Path) -> Iterator[Item]:
    """Yield the findings by design that are bad, or one item without any."""
    from haptether.studies import check_scene

    found = check_scene(scene)
    for finding in found.of("bad"):
        remedy = finding.remedy or f"edit {folder / SCENE}"
        yield Item(name=f"scene, {finding.name}", state="mend", text=finding.text, remedy=remedy)
    if not found.of("bad"):
        narrow = len(found.of("warning"))
        text = f"nothing bad by design, {narrow} with little room: haptether check {_shown(folder / SCENE)} lists all"
        yield Item(name="scene", state="ok", text=text)


def _model(scene: "Scene", answers: Answers) -> Iterator[Item]:
    """Yield an item while the numbers of a real device are placeholders."""
    driver = scene.master.driver
    if driver is None or emulates(answers) or scene.master.mass_kg not in {PLACEHOLDER_KG, JOINT_KG_M2}:
        return
    text = f"{driver}: mass and friction in [master] are placeholders, and the safety layer reads them"
    remedy = f"haptether identify {driver} --help: its last lines are a [master] table"
    yield Item(name="model", state="missing", text=text, remedy=remedy)


def _device(
    name: str,
    side: Literal["master", "slave", "gripper"],
    driver: str,
    options: dict[str, Any],
    *,
    in_use: bool,
    answers: Answers,
    folder: Path,
) -> Item:
    from haptether.bridge.scene.save import toml_value

    if driver in {SIMULATED, NONE}:
        return Item(name=name, state="ok", text="a model")
    if in_use:
        return Item(name=name, state="ok", text=f"{driver}: in use by the slave that runs, which has checked it")
    settings = [f"{key}={toml_value(value)}" for key, value in options.items()]
    check = ["check-device", driver, "--side", side, "--options", *settings]
    remedy = f"haptether {shlex.join(check)}"
    if (absent := _absent(driver, options)) is not None:
        emulator = f"{_shown(folder / EMULATORS)}, in a terminal of its own"
        start = emulator if emulates(answers) else "switch it on and connect it"
        remedy = f"{start}; then {_again(folder)}"
        return Item(name=name, state="missing", text=f"{driver}: {absent}", remedy=remedy)
    if driver == SERVOS and emulates(answers):
        # No person has to hold an emulated arm.
        check.append("--yes")
    print(f"{name}: {remedy}", file=sys.stderr, flush=True)
    status, report = _run(*check, "--duration-s", str(CHECK_S))
    if report is None:
        return Item(name=name, state="missing", text=f"{driver}: was not checked: see above", remedy=remedy)
    wrong = [f"{one['check']}: {one['text']}" for one in report["findings"] if one["verdict"] == "mend"]
    if status != 0:
        return Item(name=name, state="mend", text=f"{driver}: {'; '.join(wrong)}", remedy=remedy)
    return Item(name=name, state="ok", text=f"{driver}: passes check-device")


def _absent(driver: str, options: dict[str, Any]) -> str | None:
    """Return why a device cannot be reached, if that is known without its driver."""
    if driver == SERVOS:
        terminal = str(options["port"])
        return None if Path(terminal).exists() else f"{terminal}: no such port"
    if driver not in PORTS:
        return None
    host, port = str(options.get("host", "127.0.0.1")), int(options.get("port", PORTS[driver]))
    try:
        socket.create_connection((host, port), timeout=PROBE_S).close()
    except OSError as error:
        return f"nothing answers at {host}, port {port}: {error.strerror or error}"
    return None


def _link(answers: Answers, folder: Path, *, is_new: bool) -> Item:
    address = answers["address"]
    check = ["check-link", "--peer", address, "--key", str(folder / KEY), "--scene", str(folder / SCENE)]
    measure = (*check, "--duration-s", str(CHECK_S), "--realtime", "off")
    report = None if is_new else _run(*measure, quiet=True)[1]
    if report is None:
        text = "no slave has the new key yet" if is_new else f"no free slave answers at {address}"
        remedy = f"{_shown(folder / SLAVE)}, at the side of the arm; then {_again(folder)}"
        return Item(name="link", state="missing", text=text, remedy=remedy)
    verdict, link = report["verdict"], report["link"]
    if not verdict["good"]:
        text = "; ".join(verdict["complaints"])
        return Item(name="link", state="mend", text=text, remedy="docs/choosing.md, and haptether check-link --help")
    text = f"good enough: round trip {1e3 * link['round_trip_p50_s']:.1f} ms"
    return Item(name="link", state="ok", text=text)


def _run(*arguments: str, quiet: bool = False) -> tuple[int, dict[str, Any] | None]:
    """Run an own command; return its status and its JSON, None without one. A person answers on this terminal."""
    from haptether.child import child_environment, module_command

    try:
        done = subprocess.run(
            module_command("haptether", *arguments, "--json", "-"),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if quiet else None,
            env=child_environment(),
            timeout=COMMAND_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        print(f"it did not end within {COMMAND_S:g} s", file=sys.stderr, flush=True)
        return 1, None
    report: dict[str, Any] | None = msgspec.json.decode(done.stdout) if done.stdout.strip() else None
    return done.returncode, report
