"""`haptether new-driver`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

FILES = {
    "common/pyproject.toml.txt": "pyproject.toml",
    "common/__init__.py.txt": "src/@PACKAGE@/__init__.py",
    "@SIDE@/README.md.txt": "README.md",
    "@SIDE@/driver.py.txt": "src/@PACKAGE@/driver.py",
    "@SIDE@/test_driver.py.txt": "tests/test_driver.py",
}
"""Target file of each template."""


@dataclass(frozen=True, kw_only=True)
class NewDriver:
    """Write a package with a driver of your own: it can be installed, runs with a model, and has a test.

    docs/new_device.md explains each step. Marks in src/.../driver.py show the places to fill in.

    Examples:

    haptether new-driver master my-stylus

    haptether new-driver slave my-arm --out drivers/my-arm
    """

    side: Annotated[Literal["master", "slave"], tyro.conf.Positional]
    """A haptic device (master) or an arm (slave)."""
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Name of the driver and of its package: small letters, digits, and dashes between."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Target folder, empty or new; by default NAME, here."""

    def run(self) -> int:
        """Write the files.

        Raises:
            ValueError: A name that no package can have, or a folder that is not empty.
            OSError: The folder cannot be written.
        """
        from haptether.bridge import MASTERS, SLAVES, device_names
        from haptether.cli.new.package import checked_package, class_name, install_line, write_package

        taken = {"simulated", *device_names(MASTERS), *device_names(SLAVES)}
        package = checked_package(self.name, taken, of="driver")
        folder = Path(self.name) if self.out is None else self.out
        words = {
            "@NAME@": self.name,
            "@PACKAGE@": package,
            "@CLASS@": class_name(self.name),
            "@GROUP@": f"haptether.{self.side}s",
            "@SIDE@": self.side,
            "@KIND@": "driver",
        }
        write_package(folder, FILES, words)
        print(f"{folder}: a driver of a {self.side}, to be filled in: {folder}/src/{package}/driver.py")
        print(f"next: {install_line(folder)} && haptether check-device {self.name}")
        return 0
