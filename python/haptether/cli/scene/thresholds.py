"""`haptether thresholds`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.studies import TradeOff


@dataclass(frozen=True, kw_only=True)
class Thresholds(PictureOptions):
    """Sweep the thresholds of safety controllers: false trips per hour against missed releases, over round trips.

    The tasks are bundled scenes, done by many random hands. Some hold throughout: each intervention is a false trip.
    Others let go under force: a release is missed if the device is faster than 0.5 m/s within 0.5 s. Only releases that
    exceed it without a controller count. The paper's laws stand beside ours, each with a hold-off of 0.1 s and a
    release ramp of 0.2 s. The same seed gives the same result. Results, and how to choose: docs/thresholds.md.

    Examples:

    haptether thresholds remote_push --controller hsc --hands 4

    haptether thresholds --hands 16 --json thresholds.json --plot thresholds.png
    """

    task: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SCENE ...]")] = ()
    """Names of bundled scenes; by default all in which a hand works."""
    controller: Annotated[str | None, tyro.conf.arg(metavar="NAME,...")] = None
    """Controllers whose thresholds are swept, separated by commas; by default wsc, hsc and vfc."""
    round_trip_s: tuple[float, ...] | None = None
    """Round trips in s; by default from 0 to 0.5."""
    hands: int | None = None
    """Number of hands for each task, 1 or more; by default 8."""
    releases: int | None = None
    """Number of places on the felt path at which hands let go, 1 or more; each hand lets go once. By default 4."""
    population: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE.toml")] = None
    """A population whose hands do the tasks, instead of hands of 200 to 600 N/m and 8 to 25 N s/m. Hands too soft for
    the force of a task are skipped: docs/populations.md."""
    seed: int = 1
    """Seed of hands and links, 0 or more."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a field of all scenes first; may be given often."""
    threads: int | None = None
    """Number of threads; by default the number of processors."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write rates with 95 % intervals, and counts of each task, as JSON; - for standard output."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """Draw missed releases over false trips as .png, .pdf or .svg."""

    def run(self) -> int:
        """Run all tasks and print, for each law, its thresholds over round trips."""
        from haptether.cli.scene.simulate import spinner
        from haptether.cli.shared.numbers import check_random_seed
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.picture import asked_picture
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.unusual import ask_units, check_times, tasks_of
        from haptether.studies import THRESHOLD_LAWS, THRESHOLD_TASKS, HandBounds, draw_trade_off, measure_thresholds
        from haptether.studies.task import HANDS, RELEASES, ROUND_TRIPS_S
        from haptether.studies.thresholds.trade_off import MAX_ROUND_TRIP_S

        check_target(self.json, force=self.force)
        check_random_seed(self.seed)
        check_times("--round-trip-s", self.round_trip_s or (), MAX_ROUND_TRIP_S)
        known = sorted({law.controller for law in THRESHOLD_LAWS})
        names = known if self.controller is None else self.controller.split(",")
        if unknown := [name for name in names if name not in known]:
            message = f"--controller {self.controller}: {unknown[0]!r} is none of {', '.join(known)}"
            raise ValueError(message)
        picture = asked_picture(self.plot, self)
        tasks, console = self.task or THRESHOLD_TASKS, screen(self.json)
        ask_units(
            console,
            tasks_of(tasks, self.set),
            (("--round-trip-s", each) for each in self.round_trip_s or ()),
        )
        with spinner("thresholds") as say:
            found = measure_thresholds(
                tasks=tasks,
                laws=[law for law in THRESHOLD_LAWS if law.controller in names],
                round_trips_s=ROUND_TRIPS_S if self.round_trip_s is None else self.round_trip_s,
                hands=HANDS if self.hands is None else self.hands,
                releases=RELEASES if self.releases is None else self.releases,
                seed=self.seed,
                bounds=HandBounds(population=self.population),
                overrides=self.set,
                threads=self.threads,
                progress=say,
            )
        self._print(console, found)
        if self.json is not None:
            points = {"laws": found.laws, "points": found.points(), "rows": found.rows}
            write_report(self.json, {"seed": found.seed, "hands": found.hands, "tasks": found.tasks, **points})
        if picture is not None:
            draw_trade_off(found, picture, self.page_columns)
            console.print(f"picture: {picture}")
        return 0

    def _print(self, console: "Console", found: "TradeOff") -> None:
        from haptether.cli.shared.table import Column, Rows

        trips = found.round_trips_s
        columns = [Column(f"{round_trip_s * 1e3:g} ms", numbers=True) for round_trip_s in trips]
        table = Rows("law", Column("threshold", numbers=True), *columns, keys=2, gap=1)
        for law in found.laws:
            for value in law.values:
                cells = []
                for round_trip_s in trips:
                    counts = found.over(law.name, value, round_trip_s=round_trip_s)
                    missed = "-" if counts.releases == 0 else f"{100.0 * counts.missed_share:.0f} %"
                    rate = f"{counts.per_hour:.0f}" if counts.hours else "-"
                    cells.append(f"{rate} {missed}")
                mark = "*" if value == law.default else ""
                table.add(law.name, f"{mark}{value:g} {law.unit}", *cells)
        console.print(table)
        first = found.over(found.laws[0].name, found.laws[0].values[0], round_trip_s=trips[0])
        console.print(
            f"\nOf each round trip: false trips per hour, and the share of {first.releases} releases that was missed"
            f" ({first.hours * 3600.0:.0f} s held). * is the paper's value, or the default."
        )
