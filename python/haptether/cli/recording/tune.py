"""`haptether tune`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.studies import RocPoint, TunedThreshold, Tuning


@dataclass(frozen=True, kw_only=True)
class Tune(PictureOptions):
    """Find thresholds of [safety] from recordings of normal operation: how often they trip falsely, what they miss.

    In each recording the master's hand holds throughout. The observers see it again. For each one the most sensitive
    threshold is taken that is exceeded at most --false-trips-per-h times per hour, at a confidence. The threshold is an
    order statistic of the recorded values, without an assumed distribution. Then many simulated hands let go in the
    scene, under the force that they press with or that pushes them. The command prints a table [safety] with false
    trips per hour, missed releases, their intervals, and the maximum ejection velocity (MEV). Method, and how many
    recordings it takes: docs/tune.md.

    Exit status 1: the recordings are too short for the request; 2: they cannot be used, because a hand lets go in them
    or was never coupled, or the devices differ.

    Examples:

    haptether tune monday/master.mcap tuesday/master.mcap

    haptether tune *.mcap --scene remote_push --false-trips-per-h 10 --plot tune.png

    haptether tune *.mcap --set safety.window=10 --set safety.wsc_force_threshold_n=0.1 --json -
    """

    recording: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING ...")]
    """Files of `--record` of the master, with hands that hold."""
    scene: str | None = None
    """Scene in which hands let go: name of a bundled scene or path of a TOML file; by default the scene of the first
    recording."""
    threshold: tuple[str, ...] | None = None
    """One of energy_threshold_j, grasp_threshold, hsc_force_threshold_n and velocity_threshold for each controller; by
    default those of the recording's controllers."""
    false_trips_per_h: float = 60.0
    """Largest number of false trips per hour held, of each controller."""
    confidence: float = 0.95
    """Confidence that this is kept, 0.5 to 0.9999; also of all intervals."""
    round_trip_s: float | None = None
    """Round trip of the releases in s; by default the median of the recordings."""
    hands: int = 16
    """Number of hands that let go, 1 or more; each once."""
    releases: int = 4
    """Number of release times, 1 or more."""
    population: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE.toml")] = None
    """A population whose hands let go, instead of hands of 200 to 600 N/m and 8 to 25 N s/m. Hands too soft for the
    scene's force are skipped: docs/populations.md."""
    seed: int = 1
    """Seed of hands and links, 0 or more."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="safety.KEY=VALUE")] = ()
    """Change a setting of the observers first; may be given often."""
    threads: int | None = None
    """Number of threads; by default the number of processors."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write thresholds, ROC curves and events as JSON; - for standard output."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """Draw events over each observer's values and ROC curves as .png, .pdf or .svg."""

    def run(self) -> int:
        """Tune; return 0, or 1 if the recordings are too short."""
        from haptether.cli.recording.files import check_files
        from haptether.cli.scene.simulate import spinner
        from haptether.cli.shared.numbers import check_random_seed
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.picture import asked_picture
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.unusual import ask_units, check_times
        from haptether.studies import HandBounds, draw_tuning, tune
        from haptether.studies.task import MAX_ROUND_TRIP_S

        check_target(self.json, force=self.force)
        check_random_seed(self.seed)
        round_trips_s = () if self.round_trip_s is None else (self.round_trip_s,)
        check_times("--round-trip-s", round_trips_s, MAX_ROUND_TRIP_S)
        picture = asked_picture(self.plot, self)
        check_files(*self.recording)
        console = screen(self.json)
        ask_units(console, (), (("--round-trip-s", each) for each in round_trips_s))
        with spinner("tune") as say:
            found = tune(
                self.recording,
                scene=self.scene,
                fields=self.threshold,
                false_trips_per_h=self.false_trips_per_h,
                confidence=self.confidence,
                round_trip_s=self.round_trip_s,
                hands=self.hands,
                releases=self.releases,
                seed=self.seed,
                bounds=HandBounds(population=self.population),
                overrides=self.set,
                threads=self.threads,
                progress=say,
            )
        self._print(console, found)
        if self.json is not None:
            fields = {name: getattr(found, name) for name in found.__struct_fields__}
            write_report(self.json, {**fields, "reached": found.reached, "toml": found.toml()})
        if picture is not None:
            draw_tuning(found, picture, self.page_columns)
            console.print(f"picture: {picture}")
        return 0 if found.reached else 1

    def _print(self, console: "Console", found: "Tuning") -> None:
        from haptether.cli.shared.table import Column, Rows

        held = f"{found.hours * 60.0:.3g} min"
        console.print(
            f"{len(found.files)} recordings, {held} held in {found.blocks} independent parts, round trip"
            f" {found.round_trip_s * 1e3:.3g} ms\n"
        )
        columns = [Column(name, numbers=True) for name in ("value", "false trips per h", "missed", "MEV [m/s]")]
        table = Rows("threshold", *columns, gap=2)
        for each in found.thresholds:
            table.add(each.field, *_cells(each.point, each.unit))
            if each.recorded != each.point:
                table.add("  as recorded", *_cells(each.recorded, each.unit))
        console.print(table)
        console.print("")
        for text in (*(text for each in found.thresholds for text in _remarks(each, found)), *found.notes):
            console.print(f"- {text}")
        console.print("")
        console.print(found.toml(), end="")


def _cells(point: "RocPoint", unit: str) -> tuple[str, ...]:
    low, high = point.false_trips_per_h_interval
    return (
        f"{point.threshold:g} {unit}".strip(),
        f"{point.false_trips_per_h:.3g} ({low:.2g} to {high:.3g})",
        f"{point.missed}/{point.releases}" if point.releases else "-",
        "-" if point.mev is None else f"{point.mev:.2f}",
    )


def _remarks(each: "TunedThreshold", found: "Tuning") -> list[str]:
    """Return the remarks on a threshold, and on what the recordings cannot tell about it."""
    remarks = []
    if not each.reached:
        remarks.append(
            f"{each.field}: too short: {found.hours * 60.0:.3g} min say no less than {each.most_per_h:.3g} false trips"
            f" per hour at {100.0 * found.confidence:g} %; {found.per_hour:g} take {each.needed_hours * 60.0:.3g} min"
            + (", and the threshold is the largest value seen" if each.order else "")
        )
    if each.order == 0:
        remarks.append(f"{each.field}: nothing came near it: the recorded one is kept")
    if each.interventions:
        remarks.append(
            f"{each.field}: {each.controller} intervened {len(each.interventions)} times, first in"
            f" {each.interventions[0]}: how high its observer would have gone was not seen, each counts above every"
            " threshold"
        )
    if each.point.missed:
        best = each.none_missed
        remarks.append(
            f"{each.field}: misses {each.point.missed} of {each.point.releases} releases; "
            + (
                "so does every threshold that was looked at"
                if best is None
                else f"{best.threshold:g} misses none, at {best.false_trips_per_h:.3g} false trips per hour"
            )
        )
    return remarks
