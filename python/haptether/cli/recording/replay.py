"""`haptether replay`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from haptether.bridge import Replay as Replayed
    from haptether.cli.shared.screen import Screen


@dataclass(frozen=True, kw_only=True)
class Replay(PictureOptions):
    """Replay a recorded master with other settings: what the hand would have felt, and where the two runs diverge.

    Motion, remote force, network and ladder are those of the recording, tick by tick. Without --set the forces are
    those of the recording, bit for bit. With --set, a model of the hand, identified from the recording, responds to the
    changed force (--hand modelled). If none can be identified, the hand moves as measured, and the output says so.

    --set takes keys of [safety], [coupling] and [master] that affect the force on the hand. Exit status 1: a recording
    was not reproduced under its own settings; 2: it cannot be replayed.

    Examples:

    haptether replay master.mcap

    haptether replay master.mcap --set safety.controllers=[] --plot parted.png

    haptether replay master.mcap --set safety.controllers=[hsc] --hand measured --json -
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File of `--record` of the master."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a setting; may be given often. Values are TOML, bare words are strings."""
    hand: Literal["measured", "modelled"] | None = None
    """Let the hand move as measured, or let a model of it respond to the changed force; by default modelled if settings
    differ and the hand can be identified."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """Draw recorded and replayed into this file: .png, .pdf or .svg."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the result as JSON; - for standard output."""

    def run(self) -> int:
        """Replay; return 0, or 1 if a recording differs under its own settings.

        Raises:
            ValueError: A recording that cannot be replayed, or invalid settings.
        """
        from haptether.bridge import read_recording, replay
        from haptether.cli.recording.files import check_files
        from haptether.cli.scene.simulate import spinner
        from haptether.cli.shared.output import check_distinct, check_target, write_report
        from haptether.cli.shared.picture import asked_picture
        from haptether.cli.shared.screen import screen

        check_distinct(FILE=self.file, plot=self.plot, json=self.json)
        check_files(self.file)
        check_target(self.json, force=self.force)
        picture = asked_picture(self.plot, self)
        with spinner(f"replaying {self.file}"):
            recording = read_recording(self.file)
            try:
                done = replay(recording, overrides=self.set, hand=self.hand)
            except ValueError as error:
                message = f"{self.file}: {str(error).removeprefix(f'{recording.side}: ')}"
                raise ValueError(message) from None
        console = screen(self.json)
        _print(self.file, done, console, of="all" if recording.whole and not recording.problems else "the valid")
        write_report(self.json, reported(self.file, done))
        if picture is not None:
            from haptether.view.figures.replay import draw_replay
            from haptether.view.style.figure import write_figure

            write_figure(draw_replay(done, self.page_columns), picture)
            console.print(f"picture: {picture}")
        return int(not self.set and self.hand != "modelled" and not done.identical)


def reported(file: Path, done: "Replayed") -> dict[str, Any]:
    """Return the result of a replay as numbers and names for JSON."""
    return {
        "file": str(file),
        "level": done.level,
        "overrides": done.overrides,
        "ticks": len(done.time_s),
        "identical": done.identical,
        "parts_s": done.parts_s,
        "ends_s": done.ends_s,
        "recorded": done.before,
        "replayed": done.after,
        "largest_displacement": done.largest_displacement,
        "hand": done.hand,
        "notes": done.notes,
    }


def _print(file: Path, done: "Replayed", console: "Screen", *, of: str) -> None:
    import msgspec

    from haptether.cli.shared.table import Column, Rows

    table = Rows(f"{file}", Column("recorded", numbers=True), Column("replayed", numbers=True))
    before, after = msgspec.to_builtins(done.before), msgspec.to_builtins(done.after)
    for name, label in ROWS.items():
        if before[name] is not None:
            table.add(label, f"{before[name]:.4g}", f"{after[name]:.4g}")
    if done.hand is not None:
        table.add("hand elsewhere by at most [mm]", "-", f"{done.largest_displacement * 1e3:.4g}")
    console.print(table)
    console.print(f"level: {LEVELS[done.level]}")
    if (hand := done.hand) is not None:
        console.print(
            f"hand: K = {hand.stiffness:.4g} ± {hand.stiffness_error:.2g} N/m, B = {hand.damping:.3g} ± "
            f"{hand.damping_error:.2g} N s/m, M = {hand.mass_kg:.2g} kg, by {hand.windows} windows; the model explains "
            f"{hand.explained:.0%} of what the remote force moves",
        )
    if done.identical:
        console.print(f"the forces of {of} {len(done.time_s)} ticks are those of the recording, bit for bit")
    elif done.parts_s is None:
        console.print("the device force never differs by more than 1 mN")
    else:
        console.print(f"they part at {done.parts_s:.4f} s: from there the device force differs by more than 1 mN")
    for note in done.notes:
        console.print(f"note: {note}")


ROWS = {
    "peak_device_force": "largest force on the hand [N]",
    "peak_device_torque": "largest torque on the hand [N m]",
    "largest_speed": "largest speed with the remote push [m/s]",
    "trips": "interventions",
    "intervention_s": "time under intervention [s]",
}
"""Labels of the figures in the table."""
LEVELS = {
    "as measured": "as measured, the hand moves as it did",
    "hand modelled": "hand modelled, it answers to the force that differs",
}
"""Meaning of each level."""
