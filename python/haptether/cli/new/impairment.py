"""`haptether new-impairment`."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from haptether.cli.new.checkout import RegistryLine

FOLDER = "netsim/src/impairments"
REGISTRY = f"{FOLDER}/mod.rs"
TABLES = "netsim/link/settings.py"


@dataclass(frozen=True, kw_only=True)
class NewImpairment:
    """Write an impairment of the network into a source checkout, with its registry lines and a test.

    An impairment is a file in Rust, so it needs a source checkout and a build. The new setting of a link has the name
    of the impairment, with `_` for `-`. The file first holds a packet for 10 ms with the probability of the setting.
    Marks FILL IN show the places that are yours.

    Examples:

    haptether new-impairment micro-fade

    haptether new-impairment micro-fade --checkout ~/haptether
    """

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Name of the impairment: small letters, digits, and dashes between."""
    checkout: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Source checkout; by default the one around the working folder, or that of this installation."""

    def run(self) -> int:
        """Write the files.

        Raises:
            ValueError: An invalid or taken name, or no source checkout.
            OSError: A file cannot be written.
        """
        from haptether.cli.new.checkout import add_lines, checked_module, checkout_of, module_line, write_sources
        from haptether.cli.new.package import checked_name, class_name, from_template
        from haptether.netsim import LinkSettings

        taken = {key.replace("_", "-") for key in LinkSettings.__struct_fields__}
        module = checked_name(self.name, taken, of="impairment")
        checkout = checkout_of(self.checkout, REGISTRY)
        path = checked_module(module, checkout / FOLDER)
        words = {"@NAME@": self.name, "@MODULE@": module, "@CLASS@": class_name(self.name)}
        registry = (checkout / REGISTRY).read_text(encoding="utf-8")
        lines = [module_line(REGISTRY, registry, module), *_lines(registry, module, class_name(self.name))]
        texts = add_lines(checkout, lines)
        write_sources({path: from_template("rust/impairment.rs.txt", words), **texts})
        print(f"{path}: an impairment with its test, to be filled in")
        for changed in texts:
            print(f"{changed}: has its lines")
        print(f"next: cargo test -p haptether-netsim --lib impairments::{module} && make PROFILE=quick setup")
        print(f"then: haptether netsim sample --rate 500 --set {module}=0.1; CONTRIBUTING.md has the rest")
        return 0


def _lines(registry: str, module: str, kind: str) -> "list[RegistryLine]":
    """Return the lines of rule, setting, default, random stream and bounds in Rust, and of the setting in Python."""
    from haptether.cli.new.checkout import RegistryLine

    stream = 1 + max(int(used) for used in re.findall(r"^    [A-Z]\w* = (\d+),$", registry, re.MULTILINE))
    meaning = "Probability that a packet is held for 10 ms: FILL IN"
    held_s = f"if self.{module} > 0.0 {{ {module}::HOLD_S }} else {{ 0.0 }}"
    in_rust = {
        r"^    jitter::build,\n": f"    {module}::build,\n",
        r"\n(?=    /// Keeps packets in sending order)": f"    /// {meaning}.\n    pub {module}: f64,\n",
        r"^            trace: None,\n": f"            {module}: 0.0,\n",
        r"^pub\(crate\) enum Impairment \{\n[^}]*": f"    {kind} = {stream},\n",
        r"^            \+ self\.duplicate_gap_s\n": f"            + {held_s}\n",
        r"^            \|\| self\.jitter_s > 0\.0\n": f"            || self.{module} > 0.0\n",
    }
    in_python = {
        r"\n(?=    keep_order: bool)": f'    {module}: Share | None = None\n    """{meaning}. Source: FILL IN."""\n',
        r'\n(?=    "keep_order": True)': f'    "{module}": 0.0,\n',
    }
    return [
        *(RegistryLine(file=REGISTRY, after=after, text=text) for after, text in in_rust.items()),
        *(RegistryLine(file=TABLES, after=after, text=text) for after, text in in_python.items()),
    ]
