"""Descriptions by name or path."""

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
        return msgspec.convert(tomllib.loads(read_text(path, MAX_BYTES)), ArmDescription)
    except OSError as error:
        message = f"{path}: {error.strerror}: must be a file, or one of {', '.join(arm_names())}"
        raise ArmDescriptionError(message) from None
    except ValueError as error:
        # Those of msgspec and tomllib are ValueErrors, too.
        message = f"{path}: {error}"
        raise ArmDescriptionError(message) from None
