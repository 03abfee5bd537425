"""`haptether new-controller`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from haptether.cli.new.checkout import RegistryLine

FILES = {
    "common/pyproject.toml.txt": "pyproject.toml",
    "common/__init__.py.txt": "src/@PACKAGE@/__init__.py",
    "controller/README.md.txt": "README.md",
    "controller/controller.py.txt": "src/@PACKAGE@/controller.py",
    "controller/test_controller.py.txt": "tests/test_controller.py",
}
"""Target file of each template."""
FOLDER = "safety/src/controller"
REGISTRY = f"{FOLDER}/mod.rs"


@dataclass(frozen=True, kw_only=True)
class NewController:
    """Write a safety controller of your own, with its registry line and a test.

    By default it is a package with a controller in Python: an entry point gives it its name in scenes, `simulate`,
    `sweep` and `evaluate`. docs/own_controller.md has the interface. Live sides refuse it.

    With --rust it is a file and a registry line in the sources of Haptether, and runs on live sides after a build. This
    needs a source checkout. Marks FILL IN show the places that are yours.

    Examples:

    haptether new-controller speed-brake

    haptether new-controller speed-brake --rust
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Name of the controller: small letters, digits, and dashes between."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Target folder of the package, empty or new; by default NAME, here."""
    rust: bool = False
    """Write it in Rust into a source checkout."""
    checkout: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Source checkout for --rust; by default the one around the working folder, or that of this installation."""

    def run(self) -> int:
        """Write the files.

        Raises:
            ValueError: An invalid or taken name, a folder that is not empty, or no source checkout.
            OSError: A file cannot be written.
        """
        if self.rust and self.out is not None:
            message = "--out: a controller in Rust has its place in the checkout: omit it, or give --checkout"
            raise ValueError(message)
        if not self.rust and self.checkout is not None:
            message = "--checkout: a package in Python needs no checkout: omit it, or give --rust"
            raise ValueError(message)
        return self._in_rust() if self.rust else self._in_python()

    def _in_python(self) -> int:
        from haptether.cli.new.package import checked_package, class_name, install_line, write_package

        package = checked_package(self.name, _taken(), of="controller")
        folder = Path(self.name) if self.out is None else self.out
        words = {
            "@NAME@": self.name,
            "@PACKAGE@": package,
            "@CLASS@": class_name(self.name),
            "@GROUP@": "haptether.controllers",
            "@KIND@": "controller",
        }
        write_package(folder, FILES, words)
        print(f"{folder}: a controller in Python, to be filled in: {folder}/src/{package}/controller.py")
        evaluate = f"haptether evaluate remote_push --quick --controller none {self.name}"
        print(f"next: {install_line(folder)} && {evaluate}")
        return 0

    def _in_rust(self) -> int:
        from haptether.cli.new.checkout import add_lines, checked_module, checkout_of, module_line, write_sources
        from haptether.cli.new.package import checked_name, class_name, from_template

        module = checked_name(self.name, _taken(), of="controller")
        checkout = checkout_of(self.checkout, REGISTRY)
        path = checked_module(module, checkout / FOLDER)
        words = {"@NAME@": self.name, "@MODULE@": module, "@CLASS@": class_name(self.name)}
        registry = (checkout / REGISTRY).read_text(encoding="utf-8")
        lines = [module_line(REGISTRY, registry, module), *_lines(self.name, module, class_name(self.name))]
        texts = add_lines(checkout, lines)
        write_sources({path: from_template("rust/controller.rs.txt", words), **texts})
        print(f"{path}: a controller in Rust with its test, to be filled in")
        for changed in texts:
            print(f"{changed}: has its line")
        print(f"next: cargo test -p haptether-safety --lib controller::{module} && make PROFILE=quick setup")
        print(
            f"then: haptether evaluate remote_push --quick --controller none {self.name}; CONTRIBUTING.md has the rest"
        )
        return 0


def _lines(name: str, module: str, kind: str) -> "list[RegistryLine]":
    """Return the lines of the registry and of the two lists of names in Python."""
    from haptether.cli.new.checkout import RegistryLine

    line = f"    /// FILL IN, Eq. 1.\n    {kind}: {module}::{kind}Controller;\n"
    live = "python/haptether/cli/live/options.py"
    return [
        RegistryLine(file=REGISTRY, after=r"^registry::controllers! \{\n[^}]*", text=line),
        RegistryLine(
            file="safety/__init__.py", after=r"^ControllerName: TypeAlias = Literal\[[^\]]*", text=f', "{name}"'
        ),
        RegistryLine(file=live, after=r"^Controller = Literal\[[^\]]*", text=f', "{name}"'),
    ]


def _taken() -> set[str]:
    from haptether.bridge import RESEARCH_CONTROLLERS, device_names
    from haptether.safety import CONTROLLERS

    return {"none", "held", "research", *(name for name, _, _ in CONTROLLERS), *device_names(RESEARCH_CONTROLLERS)}
