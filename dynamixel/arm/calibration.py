"""Calibration file of an arm: bus rate, and the map from servo to joint angle."""

import contextlib
import json
import os
import secrets
import stat
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from haptether.dynamixel.arm.settings import ServoSettings
from haptether.dynamixel.models import BAUD_RATES, SERVO_MODELS, OperatingMode
from haptether.input_file import read_text

MAX_BYTES: Final = 1 << 18
Angle = Annotated[float, Meta(ge=-1608.0, le=1608.0)]


class _Servo(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    id: int
    model: str
    sign: int = 1
    offset_rad: Angle = 0.0
    low_rad: Angle = -3.141592653589793
    high_rad: Angle = 3.141592653589793
    near_rad: Angle | None = None
    cap_a: float | None = None
    torque_constant: float | None = None
    torque_constant_uncertainty: float = 0.0
    shadows: tuple[int, ...] = ()


class _File(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    servo: list[_Servo]
    baud: int = 4_000_000


HEAD: Final = """\
# The servos of an arm, in the order of its joints: docs/dynamixel.md.
# Angle of a joint: sign * (Present Position in rad from the mechanical centre - offset_rad), in the turn within limits.
"""


def read_calibration(path: Path) -> tuple[int, tuple[ServoSettings, ...]]:
    """Read rate in bit/s and servos from a file.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file or a servo in it is invalid; names the file.
    """
    try:
        text = read_text(path, MAX_BYTES)
        if "joints" in msgspec.toml.decode(text, type=dict[str, Any]):
            message = "describes an arm (links, masses): must be a file of `haptether dynamixel calibrate`"
            raise ValueError(message)
        file = msgspec.toml.decode(text, type=_File)
        if file.baud not in BAUD_RATES:
            message = f"baud = {file.baud}: must be one of {', '.join(map(str, BAUD_RATES))}"
            raise ValueError(message)
        servos = []
        for one in file.servo:
            fields = msgspec.structs.asdict(one)
            servo_id = fields.pop("id")
            # The mode does not matter here, because follower and leader set their own.
            servos.append(_settings(servo_id, fields))
    except ValueError as error:
        message = f"{path}: {error}"
        raise ValueError(message) from None
    return file.baud, tuple(servos)


def _settings(servo_id: int, fields: dict[str, object]) -> ServoSettings:
    model = SERVO_MODELS.get(str(fields["model"]))
    modes = OperatingMode.CURRENT, OperatingMode.EXTENDED_POSITION
    mode = modes[0] if model is None or model.has_current_control else modes[1]
    return ServoSettings(servo_id=servo_id, mode=mode, **fields)  # type: ignore[arg-type]  # checked there


def write_calibration(path: Path, baud: int, servos: tuple[ServoSettings, ...]) -> None:
    """Write rate in bit/s and servos, read the file back, then replace an existing one.

    A symbolic link is followed. The file mode is preserved; a new file follows the umask.

    Raises:
        OSError: The file cannot be written; the old one is kept.
        ValueError: The new file would be invalid; the old one is kept.
    """
    path = Path(os.path.realpath(path))
    beside = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    # The umask determines the mode of this file.
    with beside.open("x", encoding="utf-8") as file:
        try:
            file.write(calibration_text(baud, servos))
            file.flush()
            with contextlib.suppress(FileNotFoundError):
                os.fchmod(file.fileno(), stat.S_IMODE(path.stat().st_mode))
            os.fsync(file.fileno())
            read_calibration(beside)
            beside.replace(path)
        except BaseException:
            beside.unlink(missing_ok=True)
            raise
    # Otherwise a power loss may lose the new name.
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        # Some file systems do not support this; the file exists nevertheless.
        with contextlib.suppress(OSError):
            os.fsync(folder)
    finally:
        os.close(folder)


def calibration_text(baud: int, servos: tuple[ServoSettings, ...]) -> str:
    """Return the content of the file."""
    lines = [HEAD, f"baud = {baud}\n"]
    for servo in servos:
        lines.append(
            "\n[[servo]]\n"
            f"id = {servo.servo_id}\n"
            f"model = {json.dumps(servo.model)}\n"
            f"sign = {servo.sign}\n"
            f"offset_rad = {servo.offset_rad:.6f}\n"
            f"low_rad = {servo.low_rad:.4f}\n"
            f"high_rad = {servo.high_rad:.4f}\n"
        )
        if servo.near_rad is not None:
            lines.append(f"near_rad = {servo.near_rad:.4f}\n")
        if servo.cap_a is not None:
            lines.append(f"cap_a = {servo.cap_a:.4f}\n")
        if servo.torque_constant is not None:
            lines.append(f"torque_constant = {servo.torque_constant:.5f}\n")
            lines.append(f"torque_constant_uncertainty = {servo.torque_constant_uncertainty:.5f}\n")
        if servo.shadows:
            lines.append(f"shadows = {list(servo.shadows)}\n")
    return "".join(lines)
