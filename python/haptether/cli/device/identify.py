"""`haptether identify`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.device.options import DriverOptions

if TYPE_CHECKING:
    from haptether.bridge.devices.standalone import StandaloneRun
    from haptether.studies.identification.excitation import Bounds, Excitation
    from haptether.studies.identification.fit import IdentifiedAxis

MARGIN_S = 5.0
"""Time in s beyond the motions after which a run is ended."""


@dataclass(frozen=True, kw_only=True)
class Identify(DriverOptions):
    """Identify mass, viscous and Coulomb friction of a haptic device, and print its [master] table.

    The device moves by itself, one axis after the other, while NOBODY HOLDS IT: sinusoidal forces of 1.3 to 11.9 Hz
    grow until a bound of travel or speed is near. The force of a hand is not measured: it would be taken for the
    device's own mass and friction. Motions that a hand makes teach nothing for the same reason. The model of each axis
    is `m A + b V + c sign(V) = F(t - delay) + F_0`, fitted by least squares, with 95 % intervals. A mass is that of
    this posture, at the tool. For a device of kind "pose" only the translation is identified.

    A person is asked on the terminal first. A device that exerts by itself, such as a leader arm against its weight,
    must be supported until it is open; a person is asked before that, too. Force, travel and speed are bounded. The
    motion ends by itself, and at once by Ctrl-C, beyond a bound, by a late sample or a fault. About 25 s an axis.

    Exit status 0: mass and friction of every axis were found; 1: some were not.

    Examples:

    haptether identify my-stylus

    haptether identify my-leader --kind joints --max-force 0.05 --travel 0.2 --axes 0 --axes 1
    """

    axes: Annotated[tyro.conf.UseAppendAction[tuple[int, ...]], tyro.conf.arg(metavar="AXIS")] = ()
    """Axes from 0 on; may be given often, by default all."""
    max_force: float | None = None
    """Largest force in N (joints: N m), at most 5 (2); by default 1 (0.1)."""
    travel: float | None = None
    """Largest distance in m (rad) from the first position, at most 0.1 (1); by default 0.02 (0.3)."""
    max_speed: float | None = None
    """Largest speed in m/s (rad/s), at most 1 (10); by default 0.3 (3)."""
    yes: bool = False
    """Do not ask before it is opened or moves. Give this flag only while standing beside it, with nobody holding it."""

    def run(self) -> int:
        """Move the device and print the findings.

        Raises:
            ValueError: No such driver, or an option out of its bounds.
            RuntimeError: The motion did not come to its end.
        """
        from haptether.bridge.devices.standalone import StandaloneRun, wait_until
        from haptether.cli.device.consent import announced, ask_before_open, check_terminal, consents
        from haptether.cli.device.options import (
            await_open,
            certain_kind,
            check_options,
            driver_options,
            is_over,
            loaded_device,
            show_tracebacks,
        )
        from haptether.cli.shared.stop import Stopped, wait
        from haptether.studies.identification.excitation import Excitation

        check_options(self)
        check_terminal("identify moves the device", yes=self.yes)
        with Stopped() as stopped:
            device = loaded_device(self, "master")
            kind = certain_kind(self, device)
            bounds = self._bounds(kind)
            paced_s = getattr(device, "period_s", None)
            period_s = paced_s if isinstance(paced_s, int | float) and paced_s > 0.0 else self.period_s
            lead = Excitation(kind, bounds, period_s=period_s, axes=self.axes or None)
            ask_before_open(self.name, device, stopped, yes=self.yes)
            with announced(self.name, device) as runs:
                run = StandaloneRun(device, lead, period_s=self.period_s, stopped=lambda: bool(stopped))
                runs.append(run)
                if await_open(self, run, stopped):
                    wait_until(lambda: lead.form.axes is not None or run.finished or bool(stopped), 5.0)
                count = lead.form.axes
                if count is not None and not run.finished and not stopped:
                    self._check_axes(run, count)
                    if consents(self._question(lead, count, kind), stopped, yes=self.yes):
                        lead.request()
                        most_s = lead.duration_s(count) + MARGIN_S
                        wait(
                            "identifying: hands off", lambda: _status(lead, run), lambda: is_over(run), stopped, most_s
                        )
                ended = run.end()
            if stopped and ended:
                raise KeyboardInterrupt
            show_tracebacks(self, run)
            self._check_end(lead, run, ended=ended)
        results = _fitted(lead, run, self.axes or tuple(range(count or 0)))
        return self._report(kind, results, lead, driver_options(self, "master"))

    def _bounds(self, kind: str) -> "Bounds":
        """Return the bounds of force, travel and speed.

        Raises:
            ValueError: A bound that is not above 0 or too large.
        """
        from haptether.studies.identification.excitation import DEFAULT_BOUNDS, LARGEST_BOUNDS, Bounds

        of = "joints" if kind == "joints" else "linear"
        default, largest = DEFAULT_BOUNDS[of], LARGEST_BOUNDS[of]
        values = {}
        for name, flag, given in (
            ("force", "max-force", self.max_force),
            ("travel", "travel", self.travel),
            ("speed", "max-speed", self.max_speed),
        ):
            value = getattr(default, name) if given is None else given
            if not 0.0 < value <= getattr(largest, name):
                message = f"{flag} = {value:g}: must be above 0 and at most {getattr(largest, name):g} for kind {kind}"
                raise ValueError(message)
            values[name] = value
        return Bounds(**values)

    def _check_axes(self, run: "StandaloneRun", count: int) -> None:
        wrong = [axis for axis in self.axes if not 0 <= axis < count]
        if wrong or len(set(self.axes)) < len(self.axes):
            run.end()
            message = f"axes = {', '.join(map(str, self.axes))}: must be of 0 to {count - 1}, each once"
            raise ValueError(message)

    def _question(self, lead: "Excitation", count: int, kind: str) -> str:
        force, length = ("N m", "rad") if kind == "joints" else ("N", "m")
        bounds = lead.bounds
        axes = ", ".join(map(str, self.axes or range(count)))
        return (
            f"{self.name} will move by itself for at most {lead.duration_s(count):.0f} s, axis {axes} one after the"
            f" other: at most {bounds.force:g} {force}, {bounds.travel:g} {length} from where it is now, "
            f"{bounds.speed:g} {length}/s.\nNobody may hold or touch it, and nothing may be in its way. Ctrl-C ends it."
        )

    def _check_end(self, lead: "Excitation", run: "StandaloneRun", *, ended: bool) -> None:
        """Raise the reason of an early end; do nothing if the motion came to its end."""
        if not ended:
            at = run.failed_at or "a call"
            message = f"{self.name}: {at}() does not return: its device keeps its last command, switch it off"
            raise RuntimeError(message)
        if run.error is not None:
            raise run.error
        if lead.is_complete:
            return
        problem = next(iter(lead.form.problems.values()), None)
        if lead.form.axes is None:
            message = f"{self.name}: no sample that the bridge takes: {problem.text if problem else 'it gave none'}"
        elif lead.begun_s is None:
            message = lead.ended or "nobody said yes: nothing was moved"
        else:
            why = lead.ended or "the time was over"
            why += f": {problem.text}" if problem else ""
            message = f"the motion was ended: {why}"
        raise RuntimeError(message)

    def _report(
        self, kind: str, results: "list[IdentifiedAxis | str]", lead: "Excitation", options: dict[str, object]
    ) -> int:
        import numpy as np

        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.screen import screen
        from haptether.cli.shared.table import Column, Rows
        from haptether.studies.identification.fit import IdentifiedAxis
        from haptether.studies.identification.table import encoder_quantum, master_table, warnings

        axes = self.axes or tuple(range(len(results)))
        by_axis = {
            axis: result for axis, result in zip(axes, results, strict=True) if isinstance(result, IdentifiedAxis)
        }
        found = list(by_axis.values())
        console = screen(self.json)
        units = ("kg m²", "N m s/rad", "N m") if kind == "joints" else ("kg", "N s/m", "N")
        names = (f"mass_kg [{units[0]}]", f"viscous [{units[1]}]", f"coulomb [{units[2]}]", "F_0", "delay [ms]")
        table = Rows(*(Column(label, numbers=True) for label in ("axis", *names, "unexplained")))
        for axis, result in zip(axes, results, strict=True):
            if isinstance(result, str):
                continue
            parts = (result.mass_kg, result.viscous, result.coulomb, result.offset_n)
            cells = [f"{part.value:.4g} ± {part.half:.2g}" for part in parts]
            cells.append(f"{1e3 * result.delay_s.value:.2f} ± {1e3 * result.delay_s.half:.2g}")
            table.add(str(axis), *cells, f"{100.0 * result.unexplained:.2g} %")
        said = [f"axis {axis}: {result}" for axis, result in zip(axes, results, strict=True) if isinstance(result, str)]
        said += warnings(by_axis, kind)
        text = None
        if found:
            console.print(table)
        if found and len(found) == lead.form.axes:
            position = np.array([reading.position for reading in lead.readings if reading is not None])
            quanta = {encoder_quantum(position[:, axis]) for axis in axes}
            quantum = quanta.pop() if len(quanta) == 1 else None
            text = master_table(self.name, options, kind, found, quantum)
            console.print(f"\n{text}\n")
        for line in said:
            console.print_item(f"NOT CERTAIN: {line}")
        if text is None and found:
            console.print_item("no [master] table: it needs every axis")
        if kind == "pose":
            console.print_item("the rotation was not identified: [master.rotation] needs numbers of its own")
        known = len(found) == len(results) and all(axis.mass_kg.is_determined for axis in found)
        write_report(
            self.json,
            {
                "driver": self.name,
                "kind": kind,
                "axes": list(axes),
                "identified": known,
                "results": results,
                "warnings": said,
                "table": text,
            },
        )
        return 0 if known else 1


def _fitted(lead: "Excitation", run: "StandaloneRun", axes: tuple[int, ...]) -> "list[IdentifiedAxis | str]":
    """Return the fitted model of each axis, from the time in which it moved, or why there is none."""
    import numpy as np

    from haptether.studies.identification.fit import NotDeterminedError, fit_axis

    ticks = [
        (tick, reading)
        for tick, reading in zip(run.ticks, lead.readings, strict=False)
        if reading is not None and tick.force is not None
    ]
    time_s = np.array([tick.read_s for tick, _ in ticks])
    written_s = np.array([tick.written_s for tick, _ in ticks])
    results: list[IdentifiedAxis | str] = []
    for axis in axes:
        begin_s, end_s = lead.spans[axis]
        moved = (time_s >= begin_s) & (time_s <= end_s)
        position = np.array([reading.position[axis] for _, reading in ticks])
        force = np.array([tick.force[0][axis] for tick, _ in ticks if tick.force is not None])
        try:
            results.append(fit_axis(time_s[moved], position[moved], written_s, force))
        except NotDeterminedError as error:
            results.append(str(error))
    return results


def _status(lead: "Excitation", run: "StandaloneRun") -> str:
    """Return the state of the motion as one line."""
    ticks = run.ticks
    reading = lead.readings[-1] if lead.readings else None
    if run.blocked_in(0.5) is not None:
        return f"{run.watched.stage}() has not returned for 0.5 s"
    if reading is None or not ticks or ticks[-1].force is None:
        return "beginning"
    x = " ".join(f"{value:+.4f}" for value in reading.position)
    force = " ".join(f"{value:+.3f}" for value in ticks[-1].force[0])
    return f"axis {'-' if lead.axis is None else lead.axis}: x {x}  F {force}"
