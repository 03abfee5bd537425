"""Descriptions by name or path."""

import tomllib
from os import PathLike
from pathlib import Path
from typing import Final

import msgspec

from haptether.dynamixel.description.tables import ArmDescription

SHIPPED: Final = Path(__file__).parent / "arms"
MAX_BYTES: Final = 1 << 16


class ArmDescriptionError(ValueError):
    """A description that there is not, or that cannot be."""


def arm_names() -> tuple[str, ...]:
    """Names of the descriptions that Haptether ships."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def load_arm(name_or_path: str | PathLike[str]) -> ArmDescription:
    """Reads a description.

    Args:
        name_or_path: One of `arm_names()`, or the path of a TOML file.

    Raises:
        ArmDescriptionError: Which file, which key, what was seen, what is allowed.
    """
    text = str(name_or_path)
    path = SHIPPED / f"{text}.toml" if text in arm_names() else Path(name_or_path)
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        message = f"{path}: {error.strerror}: must be a file, or one of {', '.join(arm_names())}"
        raise ArmDescriptionError(message) from None
    if len(raw) > MAX_BYTES:
        message = f"{path}: more than {MAX_BYTES} bytes"
        raise ArmDescriptionError(message)
    try:
        return msgspec.convert(tomllib.loads(raw.decode()), ArmDescription)
    except ValueError as error:
        # Those of msgspec, of tomllib and of a wrong encoding are ValueErrors, too.
        message = f"{path}: {error}"
        raise ArmDescriptionError(message) from None
