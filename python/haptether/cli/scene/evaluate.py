"""`haptether evaluate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from haptether.cli.shared.picture import PictureOptions

if TYPE_CHECKING:
    from rich.console import Console

    from haptether.studies import CouplingMatrix, Evaluation, Network

QUICK_ROUND_TRIPS_S = (0.0, 0.1, 0.3)
QUICK_CONTROLLERS = ("none", "hsc", "wsc", "hsc+wsc")
QUICK_HANDS, QUICK_RELEASES = 2, 2
PAGES = ("evaluation.html", "evaluation.md", "worst.toml")
"""Files in the folder of --out."""


KEPT = ("coupling.position_scale", "coupling.force_scale", "coupling.command", "coupling.tool", "coupling.quat")
"""Fields of a coupling that --couplings leaves alone."""


@dataclass(frozen=True, kw_only=True)
class Evaluate(PictureOptions):
    """Say how safe a set-up is under delay: controllers over round trips and networks, in tasks done by many hands.

    Some hands hold throughout: each intervention is a false trip. Others let go under force: a device faster than the
    limit has been thrown. Device, arm, coupling, thresholds and release law are the scene's. The command prints up to
    which round trip each set of controllers is safe. It writes a page with numbers and their intervals, the
    assumptions, and the worst release as a scene of its own. The same seed gives the same result.

    Few hands suffice to find a throw, a false trip or a loss of coupling: one such run makes a cell red or yellow. A
    safe cell needs many hands: with few it is hatched, "safe? 35 hands", and names the --hands that would confirm it.
    So compare with --quick, and use the number in the hatched cells before a person holds the device.

    Examples:

    haptether evaluate remote_push --quick

    haptether evaluate remote_push --controller none hsc hsc+wsc --round-trip-s 0 0.05 0.1 --out evaluation

    haptether evaluate remote_push --quick --network lte-driving measured.csv

    haptether evaluate remote_push --hands 40 --style paper --columns 1 --plot safety.pdf --latex safety.tex

    haptether evaluate all --quick --json - --set safety.window=10

    --couplings compares the couplings of one scene, by default remote_push. A hand presses the pair on a wall,
    withdraws and lets go. Then many hands do the task. Each coupling has gains for the pair and the network.

    haptether evaluate --couplings all --controllers all --quick --out couplings

    haptether evaluate cell.toml --couplings pd-damped pspm --controllers wsc --hands 40
    """

    scene: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SCENE ...|all")]
    """Names of bundled scenes or paths of TOML files, or all: every bundled scene in which a hand works. With
    --couplings one; by default remote_push."""
    quick: bool = False
    """Few hands, round trips and networks, and with "all" no scenes that turn: a first look, in a minute."""
    controller: Annotated[tuple[str, ...] | None, tyro.conf.arg(aliases=["--controllers"])] = None
    """Sets of controllers, the names of each joined by +, at most one of them in Python; none for no controller; all
    for each built-in controller, unions and none."""
    coupling: Annotated[tuple[str, ...] | None, tyro.conf.arg(aliases=["--couplings"], metavar="NAME ...|all")] = None
    """Couplings that are compared, or all of `haptether list`; by default the scene's alone is evaluated."""
    round_trip_s: tuple[float, ...] | None = None
    """Round trips in s, of the networks without a delay of their own."""
    network: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME|PRESET|FILE ...")] = None
    """Network: steady, jitter, loss or jitter+loss at each round trip; or with a delay of its own, a preset of
    `haptether netsim list` or a recording of `haptether netsim record` (.csv) or IRTT (.json)."""
    hands: int | None = None
    """Number of hands for each task, 1 or more; by default 8, with --quick 2. A hatched cell names how many it
    needs."""
    releases: int | None = None
    """Number of places on the felt path at which hands let go, 1 or more; each hand lets go once."""
    speed: float | None = None
    """Speed in m/s above which a release has thrown the device; by default 0.5."""
    false_trips_per_h: float | None = None
    """False trips per hour held above which a controller interferes with the task; by default 60."""
    thrown_share: float | None = None
    """Share of releases that throw, which the 95 % interval must exclude before a cell is green; by default 0.1.
    Otherwise the cell is hatched and names the hands that it needs."""
    population: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE.toml")] = None
    """A population whose hands do the tasks, instead of hands of 200 to 600 N/m and 8 to 25 N s/m. Hands too soft for
    the force of a task are skipped: docs/populations.md."""
    seed: int = 1
    """Seed of hands and networks, 0 or more."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a field of all scenes first; may be given often."""
    threads: int | None = None
    """Number of threads; by default the number of processors."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Write evaluation.html, evaluation.md and worst.toml into this folder; with --couplings the two pages."""
    plot: Annotated[Path | None, tyro.conf.arg(metavar="PICTURE")] = None
    """Draw the figure of the page as .png, .pdf or .svg."""
    latex: Annotated[Path | None, tyro.conf.arg(metavar="FILE.tex")] = None
    """Write the verdicts as a LaTeX table, and the picture of --plot as a figure; captions have the command, the
    version and the sources to cite."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write all cells as JSON; - for standard output."""

    def run(self) -> int:
        """Run all tasks; return 0."""
        from haptether.cli.scene.simulate import spinner
        from haptether.cli.shared.controller_time import controller_timed
        from haptether.cli.shared.numbers import check_random_seed
        from haptether.cli.shared.output import check_distinct, check_target, make_folder, require_matplotlib
        from haptether.cli.shared.picture import asked_picture
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.unusual import ask_units, check_times, tasks_of
        from haptether.studies import draw_evaluation, evaluate, evaluate_couplings
        from haptether.studies.task import MAX_ROUND_TRIP_S

        check_distinct(json=self.json, plot=self.plot, latex=self.latex)
        check_target(self.json, self.latex, force=self.force)
        picture = asked_picture(self.plot, self)
        check_random_seed(self.seed)
        check_times("--round-trip-s", self.round_trip_s or (), MAX_ROUND_TRIP_S)
        given = self._given()
        tasks, networks = self._tasks(), self._networks()
        if self.out is not None:
            require_matplotlib()
            make_folder(self.out)
            check_target(*(self.out / name for name in PAGES), force=self.force)
        console = screen(self.json)
        ask_units(
            console,
            tasks_of(tasks, self.set),
            (("--round-trip-s", each) for each in self.round_trip_s or ()),
        )
        with controller_timed(console), spinner("evaluate") as say:
            if self.coupling is not None:
                matrix = evaluate_couplings(
                    tasks[0], couplings=self._couplings(), networks=networks, progress=say, **given
                )
            else:
                found = evaluate(tasks, networks=networks, progress=say, **given)
        if self.coupling is not None:
            return self._report_couplings(console, matrix, picture)
        self._print(console, found)
        if self.out is not None:
            self._write_pages(console, found, self.out)
        if picture is not None:
            draw_evaluation(found, picture, self.page_columns)
            console.print(f"picture: {picture}")
        if self.latex is not None:
            self._write_latex(found, self.latex, picture)
        if self.json is not None:
            self._write_cells(found, self.json)
        return 0

    def _given(self) -> dict[str, Any]:
        """Return the arguments of an evaluation that do not depend on its kind.

        Raises:
            ValueError: A limit out of its bounds.
        """
        from haptether.safety import CONTROLLERS
        from haptether.studies import EVALUATED_CONTROLLERS, EvaluationLimits, HandBounds
        from haptether.studies.task import HANDS, RELEASES, ROUND_TRIPS_S

        limits = {
            "speed": self.speed, "false_trips_per_h": self.false_trips_per_h, "thrown_share": self.thrown_share
        }  # fmt: skip
        for name, value in limits.items():
            if value is not None and not 0.0 <= value < float("inf"):
                message = f"{name.replace('_', '-')} = {value}: must be a number of at least 0"
                raise ValueError(message)
        controllers = self.controller or (QUICK_CONTROLLERS if self.quick else EVALUATED_CONTROLLERS)
        if self.controller == ("all",):
            single = [of for of in EVALUATED_CONTROLLERS if "+" not in of] + [name for name, *_ in CONTROLLERS]
            controllers = tuple(dict.fromkeys((*single, *EVALUATED_CONTROLLERS)))
        return {
            "controllers": controllers,
            "round_trips_s": self.round_trip_s or (QUICK_ROUND_TRIPS_S if self.quick else ROUND_TRIPS_S),
            "hands": self.hands if self.hands is not None else QUICK_HANDS if self.quick else HANDS,
            "releases": self.releases if self.releases is not None else QUICK_RELEASES if self.quick else RELEASES,
            "seed": self.seed,
            "bounds": HandBounds(population=self.population),
            "limits": EvaluationLimits(**{name: value for name, value in limits.items() if value is not None}),
            "overrides": self.set,
            "threads": self.threads,
        }

    def _couplings(self) -> tuple[str, ...]:
        """Return the names of the couplings; those that do not exist are refused where they are used."""
        from haptether.studies.evaluation.matrix import COUPLING_NAMES

        named = self.coupling or ()
        return COUPLING_NAMES if "all" in named else tuple(dict.fromkeys(named))

    def _report_couplings(self, console: "Console", found: "CouplingMatrix", picture: Path | None) -> int:
        """Print a matrix of couplings, and write pages, picture and JSON that are asked for; return 0."""
        from haptether.cli.scene.couplings import couplings_report, print_couplings
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.repeat import command_line
        from haptether.private_file import write_private
        from haptether.studies import couplings_html, couplings_markdown, draw_couplings

        print_couplings(console, found)
        command = command_line("evaluate", self)
        for name, page in zip(PAGES, (couplings_html, couplings_markdown), strict=False):
            if self.out is not None:
                write_private(self.out / name, page(found, command=command).encode())
                console.print(f"page: {self.out / name}")
        if picture is not None:
            draw_couplings(found, picture, self.page_columns)
            console.print(f"picture: {picture}")
        if self.json is not None:
            write_report(self.json, couplings_report(found))
        return 0

    def _write_pages(self, console: "Console", found: "Evaluation", folder: Path) -> None:
        """Write both pages, and the worst release under a controller as a scene."""
        from haptether.bridge import save_scene
        from haptether.cli.shared.repeat import command_line
        from haptether.private_file import write_private
        from haptether.studies import evaluation_html, evaluation_markdown

        worst = next((release for release in found.worst if release.controllers != "none"), None)
        named = None
        # A file of an earlier run does not belong to these pages.
        (folder / "worst.toml").unlink(missing_ok=True)
        if worst is not None:
            named = "worst.toml"
            save_scene(
                worst.scene,
                folder / named,
                f"{worst.task}, {worst.controllers}, {worst.round_trip_s:g} s, network {worst.network}:"
                f" {worst.speed:.4f} m/s after the release.",
            )
        command = command_line("evaluate", self)
        for suffix, text in (
            ("html", evaluation_html(found, command=command, worst=named)),
            ("md", evaluation_markdown(found, command=command, worst=named)),
        ):
            path = folder / f"evaluation.{suffix}"
            write_private(path, text.encode())
            console.print(f"page: {path}")
        if named is not None:
            console.print(f"worst release under a controller: {folder / named}")

    def _write_latex(self, found: "Evaluation", path: Path, picture: Path | None) -> None:
        """Write the verdicts over all tasks, and the picture, as LaTeX."""
        from haptether.bridge import load_scene
        from haptether.cli.shared.repeat import command_line
        from haptether.private_file import write_private
        from haptether.studies.evaluation.page import confirmation, verdict_rows
        from haptether.studies.latex import LatexCaption, latex_figure, latex_table, methods_of

        by_field = [methods_of(load_scene(task, self.set)).items() for task in found.tasks]
        names = [name for of in by_field for path, some in of if path != "safety.controllers" for name in some]
        names += [name for controllers in found.controllers for name in controllers.split("+")]
        command = command_line("evaluate", self)
        of = f"{', '.join(found.tasks)}, {found.hands} hands each"
        limits = found.limits
        text = (
            f"Worst event over {of}, and the largest speed after a release. Thrown: above {limits.speed:g} m/s; false"
            f" trips: above {limits.false_trips_per_h:g} per hour held; safe? is confirmed with so many hands."
        )
        head, rows = verdict_rows(found)
        parts = [latex_table(head, rows, LatexCaption(text, command, tuple(names)), "safety")]
        if picture is not None and picture.suffix != ".svg":
            text = (
                f"Over the round trip: worst event (a), largest speed after a release (b), share of releases above the"
                f" limit (c) and false trips (d), the last two with 95 % intervals, of {of}. {confirmation(found)}"
            )
            parts.append(latex_figure(picture, LatexCaption(text, command, tuple(names)), "safety", self.page_columns))
        write_private(path, "\n".join(parts).encode())

    @staticmethod
    def _write_cells(found: "Evaluation", path: Path) -> None:
        """Write all cells, and the results derived from them, as JSON."""
        from haptether.cli.scene.couplings import network_report, verdict_report
        from haptether.cli.shared.output import write_report

        worst = [
            {name: getattr(release, name) for name in ("controllers", "task", "round_trip_s", "network", "speed")}
            for release in found.worst
        ]
        up_to = {
            name: {controllers: getattr(found, name)(controllers) for controllers in found.controllers}
            for name in ("safe_up_to_s", "confirmed_up_to_s", "unthrown_up_to_s")
        }
        verdicts = verdict_report(found)
        hatched = {controllers: len(found.unconfirmed(controllers)) for controllers in found.controllers}
        fields = ("tasks", "networks", "limits", "hands", "releases", "seed", "version", "assumed", "cells")
        report = {name: getattr(found, name) for name in fields}
        report["networks"] = network_report(found.networks)
        write_report(path, {**report, "verdicts": verdicts, "hatched": hatched, **up_to, "worst": worst})

    def _networks(self) -> "list[Network]":
        """Return the named networks.

        Raises:
            ValueError: No such network or file, or round trips for networks that all have their own.
        """
        from haptether.studies import EVALUATED_NETWORKS, network_of

        known = {network.name: network for network in EVALUATED_NETWORKS}
        networks = []
        for name in self.network or (("steady", "jitter+loss") if self.quick else tuple(known)):
            try:
                networks.append(known.get(name) or network_of(name))
            except ValueError as error:
                others = "" if Path(name).is_file() else f"; at each --round-trip-s: {', '.join(known)}"
                message = f"--network {error}{others}"
                raise ValueError(message) from None
        if self.round_trip_s is not None and all(network.own for network in networks):
            message = "--round-trip-s: each --network has a delay of its own: leave it out, or name steady, too"
            raise ValueError(message)
        return networks

    def _tasks(self) -> tuple[str, ...]:
        """Return the names of the scenes.

        Raises:
            SceneError: No scene is named.
            ValueError: Other names beside "all".
        """
        from haptether.bridge import SceneError, load_scene
        from haptether.studies import THRESHOLD_TASKS

        if self.coupling is not None:
            if not self.coupling:
                message = "--couplings: name one or more, or all"
                raise ValueError(message)
            if any(one.startswith("coupling.") and not one.startswith(KEPT) for one in self.set):
                message = "--set coupling: --couplings sets kind and gains for the pair: set them in `haptether check`"
                raise ValueError(message)
            if self.latex is not None:
                message = "--latex: has verdicts of controllers: leave it or --couplings out"
                raise ValueError(message)
            if len(self.scene) > 1 or self.scene == ("all",):
                message = "SCENE: --couplings compares couplings of one scene: name one"
                raise ValueError(message)
            return self.scene or ("remote_push",)
        if not self.scene:
            message = (
                "which scene? Name one or more of `haptether simulate --list`, paths of TOML files, or all for all"
                " bundled ones in which a hand works"
            )
            raise SceneError(message)
        if "all" in self.scene and len(self.scene) > 1:
            message = 'SCENE: "all" has all bundled tasks: give it alone'
            raise ValueError(message)
        if self.scene != ("all",):
            return self.scene
        # Contact that turns costs more than a hundred times as much.
        return tuple(name for name in THRESHOLD_TASKS if not self.quick or load_scene(name).master.kind != "pose")

    def _print(self, console: "Console", found: "Evaluation") -> None:
        from haptether.cli.shared.table import Column, Rows
        from haptether.studies.evaluation.page import confirmation, statements, verdict_rows

        head, rows = verdict_rows(found)
        table = Rows(head[0], *(Column(name, numbers=True) for name in head[1:]), gap=1)
        for row in rows:
            table.add(*row)
        console.print(table)
        console.print("")
        for statement in statements(found):
            console.print(f"- {statement}")
        for change in found.assumed:
            console.print(f"- {change}")
        console.print(
            f"\nsafe: no release above {found.limits.speed:g} m/s, coupled throughout, at most"
            f" {found.limits.false_trips_per_h:g} false trips per hour held; {found.hands} hands, all networks"
            f" together. Not measured: nobody let go where something can be felt. {confirmation(found)}"
        )
