"""`haptether cite`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from haptether.cli.shared.output import FileOptions


@dataclass(frozen=True, kw_only=True)
class Cite(FileOptions):
    """Print the sources of the methods that a scene uses.

    The methods are observers, controllers, estimator, coupling, network, hand, contact and solver. Each source is the
    one in the registry or the docstring of its method. "Paper" is "Safety Control for Impedance Haptic Interfaces".

    An entry of --bibtex has authors and year, and a note that says what the publication is used for. Add its title and
    venue by hand: the registries have none. A source without authors or year becomes a comment.

    Examples:

    haptether cite remote_push

    haptether cite my/scene.toml --bibtex methods.bib

    haptether cite paper_wall --set safety.controllers=[hsc] --json -
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped scene, or path of a TOML file."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a field first; may be given often."""
    bibtex: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the publications as BibTeX; - for standard output."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write all sources as JSON; - for standard output."""

    def run(self) -> int:
        """Print a line for each method."""
        from haptether.bridge import load_scene
        from haptether.bridge.scene.sources import TITLE, bibtex, scene_sources
        from haptether.cli.shared.output import check_distinct, check_target, write_report
        from haptether.cli.shared.screen import screen
        from haptether.private_file import write_private

        if [self.bibtex, self.json].count(Path("-")) > 1:
            message = "bibtex, json: only one of the two can go to standard output"
            raise ValueError(message)
        check_target(self.json, self.bibtex, force=self.force)
        check_distinct(json=self.json, bibtex=self.bibtex)
        methods = scene_sources(load_scene(self.scene, self.set))
        console = screen(self.bibtex if str(self.bibtex) == "-" else self.json)
        for method in methods:
            console.print_item(f"{method.used_as}: {method.source}")
        if any("paper" in method.source for method in methods):
            console.print_item(f'paper: "{TITLE}"')
        if str(self.bibtex) == "-":
            print(bibtex(methods), end="")
        elif self.bibtex is not None:
            write_private(self.bibtex, bibtex(methods).encode())
        write_report(self.json, {"scene": self.scene, "paper": TITLE, "methods": methods})
        return 0
