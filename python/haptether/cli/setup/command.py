"""`haptether setup`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from haptether.cli.setup.preflight import Item
    from haptether.cli.setup.questions import Answers


@dataclass(frozen=True, kw_only=True)
class Setup(FileOptions):
    """Ask for device, arm, gripper and addresses; write scene, key and start scripts; check what can be checked.

    Each question may be answered by its option. On a terminal the others are asked, and a wrong answer is asked again.
    Without a terminal it takes and prints the default; a wrong answer, or a missing one without a default, ends the
    command. A wrong option of a driver ends it, too. Then nothing is written. docs/setup.md shows a whole installation.

    The files are scene.toml, arm.key, start-slave.sh, start-master.sh and setup.json, with emulators also
    start-emulators.sh. The checks cover key, scene, arm, gripper, haptic device and link, at the end where this machine
    is. They move no arm and couple nothing: only a person who runs start-master.sh on a terminal presses the clutch.

    Exit status 1: a check has found something to mend; with --check also if something is missing.

    Examples:

    haptether setup

    haptether setup pair --master simulated --arm ur --emulate yes --address 127.0.0.1:9000

    haptether setup cell --master inverse3 --arm ur --arm-address 192.168.1.10 --address 192.0.2.7:9000 --end master

    haptether setup cell --check --end slave
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")] = Path("cell")
    """Target folder, empty or new; with --check one that `setup` has written."""
    master: str | None = None
    """Driver of the haptic device, or simulated."""
    arm: str | None = None
    """Driver of the arm, or simulated."""
    gripper: str | None = None
    """Driver of the gripper, simulated, or none."""
    emulate: Annotated[str | None, tyro.conf.arg(metavar="yes|no")] = None
    """Emulators in the place of the devices that have one: ur, dynamixel, inverse3, robotiq."""
    address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Address of the side of the arm, as the side of the hand reaches it."""
    end: Annotated[str | None, tyro.conf.arg(metavar="master|slave|both")] = None
    """Side of this machine, whose devices are checked; also with --check, for a folder from the other machine."""
    master_address: Annotated[str | None, tyro.conf.arg(metavar="PORT|HOST")] = None
    """Serial port of a leader arm, or address of the service of an Inverse3."""
    master_file: Annotated[str | None, tyro.conf.arg(metavar="PATH")] = None
    """Calibration of a leader arm, as `haptether dynamixel calibrate` writes it."""
    master_options: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Further option of the driver of the haptic device; may be given often."""
    arm_address: Annotated[str | None, tyro.conf.arg(metavar="HOST|PORT")] = None
    """Address of the controller of a UR arm, or serial port of a follower arm."""
    arm_file: Annotated[str | None, tyro.conf.arg(metavar="PATH")] = None
    """Calibration of a follower arm."""
    arm_options: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Further option of the driver of the arm; may be given often."""
    gripper_address: Annotated[str | None, tyro.conf.arg(metavar="HOST")] = None
    """Address of the server of a Robotiq gripper; by default that of the arm."""
    gripper_options: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Further option of the driver of the gripper; may be given often."""
    check: bool = False
    """Only repeat the checks of an existing folder."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write answers, files and results of the checks as JSON; - for standard output."""

    def run(self) -> int:
        """Ask, write and check.

        Raises:
            ValueError: A wrong or missing answer without a terminal, a wrong option, or a folder with files.
            OSError: A file cannot be written.
        """
        from haptether.cli.setup.preflight import preflight
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.screen import screen

        check_target(self.json, force=self.force)
        console = screen(self.json)
        answers, files = self._kept() if self.check else self._written()
        for path in files:
            console.print_item(f"wrote {path}")
        items = []
        for item in preflight(answers, self.folder, is_new=not self.check):
            items.append(item)
            console.print_item(f"{item.state:<8}{item.name}: {item.text}")
            if item.remedy:
                console.print_item(f"        {'then' if item.state == 'ok' else 'do'}: {item.remedy}")
        for line in self._next(answers, items):
            console.print_item(line)
        report = {"folder": str(self.folder), "answers": answers, "files": list(map(str, files)), "checks": items}
        write_report(self.json, report)
        states = {item.state for item in items}
        return 1 if "mend" in states or (self.check and "missing" in states) else 0

    def _written(self) -> "tuple[Answers, list[Path]]":
        from haptether.cli.setup.files import check_drivers, scene_of, write_files
        from haptether.cli.setup.questions import QUESTIONS, answered

        folder = self.folder
        if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
            message = f"{folder}: is there already: must be an empty folder, or none; --check repeats its checks"
            raise ValueError(message)
        given = {question.name: getattr(self, question.name) for question in QUESTIONS}
        ask = _ask if sys.stdin is not None and sys.stdin.isatty() else None
        answers = answered(given, ask, lambda error: print(error, file=sys.stderr, flush=True))
        options = {name: _options(getattr(self, f"{name}_options")) for name in ("master", "arm", "gripper")}
        check_drivers(answers, options)
        scene = scene_of(answers, options, folder.absolute())
        return answers, write_files(answers, scene, options, folder.absolute())

    def _kept(self) -> "tuple[Answers, list[Path]]":
        import msgspec

        from haptether.cli.setup.files import ANSWERS, Kept
        from haptether.cli.setup.questions import QUESTIONS, checked_end

        path = self.folder / ANSWERS
        try:
            kept = msgspec.json.decode(path.read_bytes(), type=Kept)
        except FileNotFoundError:
            message = f"{path}: no such file: haptether setup {self.folder} writes it"
            raise ValueError(message) from None
        except msgspec.MsgspecError as error:
            message = f"{path}: {error}: write it anew by haptether setup"
            raise ValueError(message) from None
        given = {question.name: getattr(self, question.name) for question in QUESTIONS}
        end = given.pop("end")
        if useless := [name for name, value in given.items() if value is not None]:
            message = f"--{useless[0].replace('_', '-')}: has no use with --check, which takes the answers of {path}"
            raise ValueError(message)
        return kept.answers if end is None else {**kept.answers, "end": checked_end(end)}, []

    def _next(self, answers: "Answers", items: "list[Item]") -> list[str]:
        """Return the start in the order of its steps, once nothing is to be mended."""
        from haptether.cli.setup.files import EMULATORS, MASTER, SLAVE
        from haptether.cli.setup.questions import emulates

        counts = [(state, sum(item.state == state for item in items)) for state in ("missing", "mend")]
        summary = ", ".join(f"{count} {'to mend' if state == 'mend' else state}" for state, count in counts if count)
        scripts = [*([EMULATORS] if emulates(answers) else []), SLAVE, MASTER]
        start = "start, each in a terminal of its own: " + ", ".join(str(self.folder / script) for script in scripts)
        return [summary or "nothing missing", *([] if any(item.state == "mend" for item in items) else [start])]


def _options(given: tuple[str, ...]) -> dict[str, Any]:
    """Return `KEY=VALUE` options of a driver as a table.

    Raises:
        SceneError: An option without `=`, or a value that is not TOML.
    """
    from haptether.bridge.scene.load import overridden

    raw: dict[str, Any] = {}
    for option in given:
        # Any table with options.
        raw = overridden(raw, f"master.options.{option}")
    options: dict[str, Any] = raw.get("master", {}).get("options", {})
    return options


def _ask(question: str) -> str:
    """Ask on the terminal.

    Raises:
        ValueError: Standard input has ended.
    """
    print(question, end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        message = "standard input has ended: give the answers by options (haptether setup --help)"
        raise ValueError(message)
    return line
