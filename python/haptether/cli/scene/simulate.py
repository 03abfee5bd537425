"""`haptether simulate`."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.bridge import Run, Scene

SPINNER_AFTER_S = 2.0
EVENTS_SHOWN = 20


@dataclass(frozen=True, kw_only=True)
class Simulate(PictureOptions):
    """Run a scene in virtual time: device, hand, arm, environment, network and safety from one TOML file.

    SCENE is the name of a scene that comes with Haptether (--list) or the path of a TOML file. Any field can be
    changed, as --set table.key=value or as --table.key value. The same scene and seed give the same numbers. Exit
    status 1: the loop diverged or never engaged; 2: the scene cannot be built.

    Examples:

    haptether simulate --list

    haptether simulate remote_push

    haptether simulate remote_push --link.forward.delay-s 0.1 --set safety.controllers=[] --plot out/remote_push

    haptether simulate my/scene.toml --json - --out run.npz

    haptether simulate remote_push --record out
    """

    scene: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")] = None
    """Name of a shipped scene, or path of a TOML file."""
    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="TABLE.KEY=VALUE"),
    ] = ()
    """Change a field; may be given often. Values are TOML, bare words are strings."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write events, metrics, the bound on ejection speed and the return of the force as JSON; - for standard output."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="DIR|PICTURE")] = None
    """Draw positions, forces, rotations and trips, into this folder or as this .png, .pdf or .svg."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.npz")] = None
    """Write every signal as a NumPy array."""
    record: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Record both sides like `--record` of live ones: DIR/master.mcap and DIR/slave.mcap."""
    list: bool = False
    """List the scenes, and end."""

    def run(self) -> int:
        """Run the scene; return 0, or 1 if it diverged or the two sides never engaged."""
        from haptether.bridge import SceneError, load_scene, simulate
        from haptether.cli.shared.controller_time import controller_timed
        from haptether.cli.shared.output import check_target, make_folder
        from haptether.cli.shared.picture import check_picture_options, picture_in
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.unusual import ask_units

        console = screen(self.json)
        if self.list:
            self._check_list()
            self._list(console)
            return 0
        if self.scene is None:
            message = "which scene? Name one of `haptether simulate --list`, or give the path of a TOML file"
            raise SceneError(message)
        check_target(self.json, self.out, force=self.force)
        if self.out is not None and self.out.suffix != ".npz":
            message = f"{self.out}: must end in .npz"
            raise ValueError(message)
        check_picture_options(self.plot, self)
        picture = None
        if self.plot is not None:
            picture = picture_in(self.plot, Path(self.scene).stem, self.format, force=self.force)
        scene = load_scene(self.scene, self.set)
        files = None
        if self.record is not None:
            make_folder(self.record)
            files = (self.record / "master.mcap", self.record / "slave.mcap")
            check_target(*files, force=self.force)
        if scene.record is None and (self.plot is not None or self.out is not None):
            message = f"{self.scene} has no [record], so there are no signals to keep: add --set record.every=1"
            raise SceneError(message)
        ask_units(console, [scene])
        with controller_timed(console), spinner(f"running {self.scene}"):
            run = simulate(self.scene, overrides=self.set, record=files)
        named = {
            "slave.device": None if scene.slave is None else scene.slave.device,
            "master.driver": scene.master.driver,
        }
        for key, name in named.items():
            if name not in {None, "simulated"}:
                table = key.partition(".")[0]
                console.print(
                    f"{key} = {name}: the model of [{table}] stands for it; `haptether {table} --scene` drives it live",
                )
        return self.report(console, run, picture, scene)

    def report(self, console: "Console", run: "Run", picture: Path | None, scene: "Scene | None" = None) -> int:
        """Print, write and draw the results of a run; return 0.

        Args:
            console: Output.
            run: The run.
            picture: Path of the picture; None for none.
            scene: Scene of the run, for its bound; None for a run with a recorded hand.

        Raises:
            RuntimeError: It diverged, or the two sides never engaged.
        """
        from haptether.cli.shared.ejection import bound_line, release_law, release_line, scene_bound
        from haptether.cli.shared.output import write_report

        self._print(console, run)
        if (swing_n := run.contact_swing_n) is not None:
            console.print(
                f"the force swings by {swing_n:.3g} N peak to peak and does not settle: `haptether check` names the "
                "delay and the stiffness that the coupling bears"
            )
        bound = None if scene is None else scene_bound(scene)
        if scene is not None and bound is not None:
            console.print(bound_line(scene, bound))
            if (line := release_line(scene)) is not None:
                console.print(line)
        report = {
            "scene": run.scene,
            "seed": run.seed,
            "version": run.version,
            "events": run.events,
            "metrics": run.metrics,
            "contact_swing_n": swing_n,
            "ejection_bound": bound,
            "release_law": None if scene is None else release_law(scene),
        }
        write_report(self.json, report)
        if self.out is not None:
            run.save(self.out)
            console.print(f"signals: {self.out}")
        if self.record is not None:
            console.print(f"recorded: {self.record / 'master.mcap'}, {self.record / 'slave.mcap'}")
        if picture is not None:
            run.plot(picture, columns=self.page_columns)
            console.print(f"picture: {picture}")
        if run.metrics.diverged:
            last = next((event for event in run.events if event.kind == "diverged"), None)
            cause = f" at {last.time_s:g} s: {last.detail}" if last is not None else ""
            message = f"{run.scene} diverged{cause}"
            raise RuntimeError(message)
        if run.metrics.outcome == "never-engaged":
            why = next((f": {event.detail}" for event in run.events if event.kind == "never-engaged"), "")
            message = f"{run.scene} was never engaged, so that nothing was measured{why}"
            raise RuntimeError(message)
        return 0

    def _print(self, console: "Console", run: "Run") -> None:
        import msgspec

        from haptether.bridge.scene.labels import METRICS
        from haptether.cli.shared.table import Column, Rows

        table = Rows(run.scene, Column(f"seed {run.seed}", numbers=True))
        for name, value in msgspec.to_builtins(run.metrics).items():
            if name in OF_ROTATION and value is None:
                continue
            table.add(METRICS.get(name, name), shown(value))
        console.print(table)
        from haptether.view.figures.events import merged_events

        events = merged_events(run.events)
        for time_s, text in events[:EVENTS_SHOWN]:
            console.print(f"  {time_s:9.4f} s  {text}")
        if len(events) > EVENTS_SHOWN:
            console.print(f"  and {len(events) - EVENTS_SHOWN} more; --json has all events")

    def _check_list(self) -> None:
        """Refuse options that `--list` would ignore.

        Raises:
            ValueError: An option beside `--list`; the message names the first.
        """
        for field in fields(self):
            if field.name != "list" and (value := getattr(self, field.name)) != field.default:
                option = f"SCENE {value}" if field.name == "scene" else f"--{field.name.replace('_', '-')}"
                message = f"--list, {option}: no scene is run where all are listed: leave one of the two out"
                raise ValueError(message)

    def _list(self, console: "Console") -> None:
        from haptether.bridge import load_scene, scene_names
        from haptether.cli.shared.table import Rows

        table = Rows("scene", "shows")
        for name in scene_names():
            table.add(name, load_scene(name).shows)
        console.print(table)


OF_ROTATION = {"max_ejection_rate", "peak_device_torque", "orientation_rmse_rad", "torque_rmse_n_m"}
"""Metrics of rotations, which other tables do not show."""


def shown(value: object) -> str:
    """Return a metric as text for the screen."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@contextlib.contextmanager
def spinner(text: str) -> Iterator[Callable[[str], None]]:
    """Show a spinner on standard error after two seconds; yield a function that changes its text."""
    import threading

    from haptether.cli.shared.screen import Screen, plain

    status = Screen(stderr=True).status(text)
    timer = threading.Timer(SPINNER_AFTER_S, status.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda text: status.update(plain(text))
    finally:
        timer.cancel()
        timer.join()
        status.stop()
