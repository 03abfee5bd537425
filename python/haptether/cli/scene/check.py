"""a finding is bad. What each line computes: docs/check.md."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from haptether.cli.shared.output import FileOptions


@dataclass(frozen=True, kw_only=True)
class Check(FileOptions):
    """Check a scene against the limits of its loop, observers, bounds and link by design, before anything moves.

    Named drivers are checked with their options, as master and slave take them at their start; no device is opened. The
    findings cover the delay margin of contact and the intervals beyond it, and the stiffness of rendered walls. They
    cover the speed of a released device and the part that no threshold lowers. They compare thresholds with limits and
    with the hand's own motion, and losses with the ladder. Each has this scene's numbers and a remedy. Remedies were
    tried: each improves its finding and worsens no other. "Stable" is a linear result; cases beyond that are not
    judged. Exit status 1: something is bad.

    Examples:

    haptether check remote_push

    haptether check my/scene.toml --set link.forward.delay_s=0.2 --json -

    haptether check pick_and_place --speed 0.3
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped scene, or path of a TOML file."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a field first; may be given often."""
    speed: float | None = None
    """Speed above which a released device counts as thrown, above 0: in m/s, by default 0.5; for joints in rad/s, by
    default none."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write all findings as JSON; - for standard output."""

    def run(self) -> int:
        """Print the findings; 0, or 1 if one is bad."""
        from haptether.bridge import load_scene
        from haptether.cli.shared.design import WORDS, summary
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.unusual import ask_units
        from haptether.studies import check_scene

        check_target(self.json, force=self.force)
        scene, console = load_scene(self.scene, self.set), screen(self.json)
        ask_units(console, [scene])
        found = check_scene(scene, speed=self.speed)
        console.print(f"{self.scene}, by design:")
        for finding in found.findings:
            said = "not judged: " if finding.state == "not judged" else ""
            console.print_item(f"{WORDS[finding.state]}{finding.name}: {said}{finding.text}")
            if finding.remedy is not None:
                console.print_item(f"    mend: {finding.remedy}")
        console.print(summary(found))
        write_report(self.json, {"scene": self.scene, "findings": found.findings})
        return 1 if found.of("bad") else 0
