"""Questions of `haptether setup`, with the check of each answer."""

import ipaddress
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

Answers = dict[str, str]

SIMULATED = "simulated"
NONE = "none"
SERVOS = "dynamixel"
EMULATED = frozenset({"ur", "dynamixel", "inverse3"})
"""Drivers whose devices have emulators; that of a UR arm has a Robotiq gripper, too."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """Question about one part of the installation."""

    name: str
    """Name of the answer and of its option."""
    text: str
    allowed: Callable[[Answers], str]
    """Text of the allowed answers, from the earlier answers."""
    check: Callable[[str, Answers], str | None]
    """Returns why an answer is wrong."""
    default: Callable[[Answers], str | None] = lambda _: None
    applies: Callable[[Answers], bool] = lambda _: True

    @property
    def option(self) -> str:
        """Option of the command line."""
        return f"--{self.name.replace('_', '-')}"


def answered(given: Mapping[str, str | None], ask: Callable[[str], str] | None, say: Callable[[str], None]) -> Answers:
    """Return all answers.

    Args:
        given: Answers from options, by name.
        ask: Asks a person and returns a line; None where nobody can be asked.
        say: Takes the error of a wrong answer, which is then asked again, and each default where nobody can be asked.

    Raises:
        ValueError: A wrong or missing answer where nobody can be asked, or an option without use.
    """
    answers: Answers = {}
    for question in QUESTIONS:
        value = given[question.name]
        if not question.applies(answers):
            if value is not None:
                message = f"{question.option}: has no use with the answers before it: leave it out"
                raise ValueError(message)
            continue
        answers[question.name] = _answer(question, value, answers, ask, say)
    return answers


def _answer(
    question: Question,
    value: str | None,
    answers: Answers,
    ask: Callable[[str], str] | None,
    say: Callable[[str], None],
) -> str:
    default, allowed = question.default(answers), question.allowed(answers)
    while True:
        if value is None and ask is None and default is not None:
            value = default
            say(f"{question.option} = {value}: the default, since there is no terminal to ask on")
        if value is None:
            if ask is None:
                message = f"{question.option}: is missing: must be {allowed}"
                raise ValueError(message)
            shown = "" if default is None else f" [{default}]"
            value = ask(f"{question.text}: {allowed}{shown}: ").strip() or default or ""
        wrong = question.check(value, answers)
        if wrong is None:
            return value
        message = f"{question.option} = {value[:80]}: {wrong}: must be {allowed}"
        if ask is None:
            raise ValueError(message)
        say(message)
        value = None


def kind_of(answers: Answers) -> str:
    """Return the kind of coordinates that master and arm share."""
    if answers["master"] == SERVOS and answers["arm"] == "ur":
        return "pose"
    return "joints" if SERVOS in {answers["master"], answers["arm"]} else "linear"


def is_local(address: str) -> bool:
    """Return true if both sides are on this machine."""
    host = address.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def emulates(answers: Answers) -> bool:
    """Return true if emulators take the places of devices."""
    return answers.get("emulate") == "yes"


def _masters() -> tuple[str, ...]:
    from haptether.bridge import MASTERS, device_names

    return (SIMULATED, *device_names(MASTERS))


def _arms(answers: Answers) -> tuple[str, ...]:
    from haptether.bridge import SLAVES, device_names

    names = (SIMULATED, *device_names(SLAVES))
    if answers["master"] == SERVOS:
        # Joints, or with a UR arm the pose of the tool.
        return tuple(name for name in names if name in {SIMULATED, SERVOS, "ur"})
    # A follower of servos takes joints, which no other device has.
    return names if answers["master"] == SIMULATED else tuple(name for name in names if name != SERVOS)


def _grippers(answers: Answers) -> tuple[str, ...]:
    from haptether.bridge import GRIPPERS, device_names

    # The gripper of servos is on the bus of its arm, that of Robotiq at the controller of a real one.
    without = {SERVOS: {"robotiq"}, SIMULATED: {"robotiq", SERVOS}}.get(answers["arm"], {SERVOS})
    return (NONE, SIMULATED, *(name for name in device_names(GRIPPERS) if name not in without))


def _one_of(names: Callable[[Answers], tuple[str, ...]]) -> Callable[[str, Answers], str | None]:
    def check(value: str, answers: Answers) -> str | None:
        from difflib import get_close_matches

        if value in names(answers):
            return None
        near = get_close_matches(value, names(answers), 1)
        return f"did you mean {near[0]}?" if near else "no such choice with the answers before it"

    return check


def _listed(names: Callable[[Answers], tuple[str, ...]]) -> Callable[[Answers], str]:
    def text(answers: Answers) -> str:
        *most, last = names(answers)
        return f"{', '.join(most)} or {last}"

    return text


def _address(value: str, _: Answers) -> str | None:
    host, colon, port = value.rpartition(":")
    if not colon or not host:
        return "has no port"
    if not port.isdecimal() or not 1 <= int(port) <= 65535:
        return f"{port or 'nothing'} is no port"
    if host.startswith("["):
        return _host(host[1:-1], _, v6=True) if host.endswith("]") else "has no closing bracket"
    return _host(host, _)


def _host(value: str, _: Answers, *, v6: bool = False) -> str | None:
    from haptether.options import check_host

    if v6:
        try:
            seen = ipaddress.IPv6Address(value.partition("%")[0])
        except ValueError:
            return "is no IPv6 address"
        return "is the address of no peer" if seen.is_unspecified or seen.is_multicast else None
    try:
        check_host("address", value)
    except ValueError as error:
        return "is the address of no peer" if "no peer" in str(error) else "is no address or name"
    return None


def _arm_address(value: str, answers: Answers) -> str | None:
    if answers["arm"] == SERVOS:
        return _port(value, answers)
    if emulates(answers) and not (value.startswith("127.") and is_local(f"{value}:1")):
        return "emulators listen to this machine only"
    return _host(value, answers)


def _port(value: str, _: Answers) -> str | None:
    return None if value.startswith("/") else "is no absolute path"


def _file(value: str, _: Answers) -> str | None:
    return None if Path(value).is_file() else "no such file (haptether dynamixel calibrate writes it)"


def _devices(answers: Answers) -> set[str]:
    return {answers["master"], answers["arm"], answers["gripper"]}


def _choices(*names: str) -> Callable[[Answers], tuple[str, ...]]:
    return lambda _: names


def _has_bus(side: str) -> Callable[[Answers], bool]:
    return lambda answers: answers[side] == SERVOS and not emulates(answers)


ENDS = ("master", "slave", "both")


def checked_end(value: str) -> str:
    """Return the side of this machine.

    Raises:
        ValueError: No such side.
    """
    if value not in ENDS:
        message = f"--end = {value[:80]}: must be {_listed(_choices(*ENDS))({})}"
        raise ValueError(message)
    return value


HOST = "an IPv4 address or a name, without a port"
CALIBRATION = "the path of a file"

QUESTIONS = (
    Question(
        name="master",
        text="Haptic device of the hand",
        allowed=_listed(lambda _: _masters()),
        check=_one_of(lambda _: _masters()),
        default=lambda _: SIMULATED,
    ),
    Question(name="arm", text="Arm", allowed=_listed(_arms), check=_one_of(_arms), default=lambda _: SIMULATED),
    Question(
        name="gripper", text="Gripper", allowed=_listed(_grippers), check=_one_of(_grippers), default=lambda _: NONE
    ),
    Question(
        name="emulate",
        text="Emulators in the place of the devices",
        allowed=lambda _: "yes or no",
        check=_one_of(_choices("yes", "no")),
        default=lambda _: "no",
        applies=lambda answers: bool(_devices(answers) & EMULATED),
    ),
    Question(
        name="address",
        text="Address of the arm's side, as the hand's side reaches it",
        allowed=lambda _: "HOST:PORT, such as 192.0.2.7:9000",
        check=_address,
        default=lambda _: "127.0.0.1:9000",
    ),
    Question(
        name="end",
        text="Side of this machine",
        allowed=_listed(_choices(*ENDS)),
        check=_one_of(_choices(*ENDS)),
        default=lambda _: "both",
        applies=lambda answers: not is_local(answers["address"]),
    ),
    Question(
        name="master_address",
        text="Serial port of the leader, or address of the device's service",
        allowed=lambda answers: "the path of a serial port" if answers["master"] == SERVOS else HOST,
        check=lambda value, answers: (_port if answers["master"] == SERVOS else _host)(value, answers),
        default=lambda answers: None if answers["master"] == SERVOS else "127.0.0.1",
        applies=lambda answers: answers["master"] in {SERVOS, "inverse3"} and not emulates(answers),
    ),
    Question(
        name="master_file",
        text="Calibration of the leader",
        allowed=lambda _: CALIBRATION,
        check=_file,
        applies=_has_bus("master"),
    ),
    Question(
        name="arm_address",
        text="Address of the arm's controller, or serial port of the follower",
        allowed=lambda answers: "the path of a serial port" if answers["arm"] == SERVOS else HOST,
        check=_arm_address,
        default=lambda answers: "127.0.0.1" if emulates(answers) else None,
        applies=lambda answers: answers["arm"] == "ur" or _has_bus("arm")(answers),
    ),
    Question(
        name="arm_file",
        text="Calibration of the follower",
        allowed=lambda _: CALIBRATION,
        check=_file,
        applies=_has_bus("arm"),
    ),
    Question(
        name="gripper_address",
        text="Address of the gripper's server",
        allowed=lambda _: HOST,
        check=_host,
        default=lambda answers: answers.get("arm_address") if answers["arm"] == "ur" else None,
        applies=lambda answers: answers["gripper"] == "robotiq",
    ),
)
"""In their order; an answer may depend on those before it."""
