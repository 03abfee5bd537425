"""Loading of descriptions by name or path."""

import tomllib
from os import PathLike
from pathlib import Path
from typing import Final

import msgspec

from haptether.dynamixel.description.tables import ArmDescription
from haptether.input_file import read_text

SHIPPED: Final = Path(__file__).parent / "arms"
MAX_BYTES: Final = 1 << 16


class ArmDescriptionError(ValueError):
    """Description that does not exist or is invalid."""


def arm_names() -> tuple[str, ...]:
    """Return the names of the shipped descriptions."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def load_arm(name_or_path: str | PathLike[str]) -> ArmDescription:
    """Read a description.

    Args:
        name_or_path: One of `arm_names()`, or the path of a TOML file.

    Raises:
        ArmDescriptionError: Gives file, key, value seen, values allowed.
    """
    text = str(name_or_path)
    path = SHIPPED / f"{text}.toml" if text in arm_names() else Path(name_or_path)
    try:
        return msgspec.convert(tomllib.loads(read_text(path, MAX_BYTES)), ArmDescription)
    except OSError as error:
        message = f"{path}: {error.strerror}: must be a file, or one of {', '.join(arm_names())}"
        raise ArmDescriptionError(message) from None
    except ValueError as error:
        # Errors of msgspec and tomllib are ValueErrors.
        message = f"{path}: {error}"
        raise ArmDescriptionError(message) from None
