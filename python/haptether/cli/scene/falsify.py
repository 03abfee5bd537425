"""`haptether falsify`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.studies import Falsified, ReleaseBounds


@dataclass(frozen=True, kw_only=True)
class Falsify(FileOptions):
    """Search for the release after which a scene's device becomes fastest, and hold it to the bound on that speed.

    Device, loop, link, arm and safety are the scene's. The search varies within bounds: the force that the hand holds,
    how firmly and how suddenly it lets go, and the steps of the push after that. It varies delay, jitter and loss of a
    link and, with several axes, the direction of the push. The worst release is simplified and written as a scene of
    its own. The same seed and number of tries give the same result; a search by time tries as many as the machine can.
    Ctrl-C ends the search and keeps the worst so far, status 130. Exit status 1: the bound was exceeded.

    Needs cma, of the extra `analysis`. Derivation of the bound and its assumptions: docs/ejection_bound.md.

    Examples:

    haptether falsify paper_wall

    haptether falsify remote_push --controller wsc,hsc --seconds 600 --out worst.toml --json worst.json

    haptether falsify moving_wall --controller hsc --push any --set master.stops=[-0.08,0.08] --tries 20000 --seed 2
    """

    scene: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Name of a shipped scene, or path of a TOML file."""
    controller: Annotated[str | None, tyro.conf.arg(metavar="NAME,...")] = None
    """Controllers, separated by commas; by default the scene's."""
    seconds: float = 60.0
    """Duration of the search in s."""
    tries: int | None = None
    """Number of releases after which the search ends, even before its time."""
    seed: int = 1
    """Seed of the search, 1 or more."""
    steps: int = 8
    """Steps of the push after the release, 1 to 40."""
    decay_s: float = 0.05
    """Longest time in s in which the grip gives way; 0 for sudden releases only."""
    delay_s: float = 0.2
    """Longest delay of a direction of the link in s, where the scene has one."""
    jitter_s: float = 0.01
    """Largest standard deviation of that delay in s."""
    loss: float = 0.05
    """Largest share of packets that are lost."""
    push: Literal["auto", "any", "steady"] = "auto"
    """Any push within the cap, or a push that neither grows nor turns, as the bound of HSC assumes; auto is the push
    for which the bound holds."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a field of the scene first; may be given often."""
    threads: int | None = None
    """Number of threads; by default the number of processors."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """File of the worst release as a scene; by default SCENE_worst.toml in this folder."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write speeds, bound, margin and the release as JSON; - for standard output."""

    def run(self) -> int:
        """Search; return 0, or 130 if it was interrupted."""
        from haptether.bridge import load_scene, save_scene
        from haptether.cli.interrupts import INTERRUPTED
        from haptether.cli.scene.simulate import spinner
        from haptether.cli.shared.numbers import check_duration
        from haptether.cli.shared.output import check_target
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.unusual import ask_units, check_times
        from haptether.studies import falsify
        from haptether.studies.falsifier.release import MAX_DELAY_S, MAX_JITTER_S

        check_duration("seconds", self.seconds)
        check_times("--delay-s", [self.delay_s], MAX_DELAY_S)
        check_times("--jitter-s", [self.jitter_s], MAX_JITTER_S)
        out = self.out or Path(f"{Path(self.scene).stem}_worst.toml")
        if out.suffix != ".toml":
            message = f"{out}: must end in .toml"
            raise ValueError(message)
        check_target(self.json, out, force=self.force)
        scene, console = load_scene(self.scene, self.set), screen(self.json)
        ask_units(console, [scene])
        controllers = (
            None if self.controller is None else tuple(filter(None, self.controller.replace("+", ",").split(",")))
        )
        try:
            with spinner(f"searching {self.scene}") as say:
                found = falsify(
                    scene,
                    controllers=controllers,
                    bounds=self._bounds(),
                    seconds=self.seconds,
                    tries=self.tries,
                    seed=self.seed,
                    threads=self.threads,
                    progress=lambda tried, speed: say(f"{self.scene}: {tried} releases, up to {speed:.3f} m/s"),
                )
        except KeyboardInterrupt:
            print("haptether: interrupted before the first releases were done: there is no worst one", file=sys.stderr)
            raise
        save_scene(found.scene, out, self._comment(found))
        self._report(console, found, out)
        if found.margin is not None and found.margin < 0.0:
            message = f"{out}: {found.worst:.4f} m/s exceeds the bound of {found.bound.speed:.4f} m/s"
            raise RuntimeError(message)
        return INTERRUPTED if found.interrupted else 0

    def _bounds(self) -> "ReleaseBounds":
        from haptether.studies import ReleaseBounds

        return ReleaseBounds(
            push=self.push,
            steps=self.steps,
            decay_s=self.decay_s,
            delay_s=self.delay_s,
            jitter_s=self.jitter_s,
            loss=self.loss,
        )

    def _comment(self, found: "Falsified") -> str:
        against = " and ".join(found.scene.safety.controllers) or "nobody"
        return (
            f"The worst release against {against} that `haptether falsify {self.scene} --seed {self.seed}` found in"
            f" {found.tried} tries, made simple.\nIt throws the device at {found.speed:.4f} {unit_of(found)};"
            f" {found.bound.text(unit_of(found))}."
        )

    def _report(self, console: "Console", found: "Falsified", out: Path) -> None:
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.table import Column, Rows

        release, unit = found.release, unit_of(found)
        force = "N m" if unit == "rad/s" else "N"
        table = Rows(self.scene, Column(" + ".join(found.scene.safety.controllers) or "nobody", numbers=True))
        table.add("releases tried", str(found.tried))
        table.add(f"largest speed seen [{unit}]", f"{found.worst:.4f}")
        table.add(f"of the simple release [{unit}]", f"{found.speed:.4f}")
        if found.bound.speed is not None and found.margin is not None:
            table.add(f"bound [{unit}]", f"{found.bound.speed:.4f}")
            table.add(f"margin [{unit}]", f"{found.margin:.4f}")
            table.add("seen / bound", f"{found.worst / found.bound.speed:.3f}")
        table.add(f"held [{force}]", f"{release.held_n:.3g}")
        table.add("grip gives way in [ms]", f"{release.decay_s * 1e3:.3g}")
        table.add("steps of the push", str(len(release.level_n)))
        console.print(table)
        for after_s, level_n in zip(release.after_s, release.level_n, strict=True):
            console.print(f"  {after_s * 1e3:8.2f} ms after the release  {level_n:+.3g} {force}")
        if found.bound.speed is None:
            console.print(found.bound.text(unit))
        else:
            console.print(f"assumed: {'; '.join(found.bound.assumptions)}")
        console.print(f"scene: {out}")
        write_report(
            self.json,
            {
                "scene": self.scene,
                "controllers": found.scene.safety.controllers,
                "seed": self.seed,
                "tried": found.tried,
                "interrupted": found.interrupted,
                "worst": found.worst,
                "speed": found.speed,
                "margin": found.margin,
                "bound": found.bound,
                "release": release,
                "file": str(out),
            },
        )


def unit_of(found: "Falsified") -> str:
    """Return the unit of the speed of the scene's device."""
    return "rad/s" if found.scene.master.kind == "joints" else "m/s"
