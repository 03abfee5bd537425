"""Findings on a driver from one normal run and a second run that ends by an exception."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from haptether.bridge.devices.check.finding import Finding, messages, raised
from haptether.bridge.devices.check.form import Kind, SampleForm, Side, check_kinds
from haptether.bridge.devices.check.push import MAX_PUSH, CheckLead, Push
from haptether.bridge.devices.check.series import (
    Timing,
    bounds_of,
    check_angular_velocity,
    check_blocking,
    check_force,
    check_motion,
    check_period,
    check_positions,
    check_renewal,
    check_velocity,
    readings_of,
    timing,
)
from haptether.bridge.devices.open import CLOSE_S, KEEPS, POINT_KINDS, lowering_s
from haptether.bridge.devices.standalone import RestBy, StandaloneRun, Written

SECOND_TICKS = 5
"""Number of ticks after which the second run raises an exception."""


def kind_of(device: object) -> Kind:
    """Return the first kind of scene that a driver declares."""
    kinds: object = getattr(device, "kinds", POINT_KINDS)
    for kind in kinds if isinstance(kinds, tuple | list) else ():
        if kind in MAX_PUSH:
            return kind  # type: ignore[no-any-return]  # one of the three
    return "linear"


class DeviceCheck:
    """Driver under check: `run` steps it, `findings` reports the results.

    Args:
        device: Driver from `load_master` or `load_slave`.
        side: Side of the driver.
        kind: Kind of coordinates; by default the first that the driver declares.
        period_s: Loop period in s, if the device does not pace the loop.
        stopped: Additional condition that ends the run in the current tick.
    """

    def __init__(
        self,
        device: object,
        side: Side,
        kind: Kind | None = None,
        *,
        period_s: float = 1e-3,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self.kind = kind_of(device) if kind is None else kind
        self.loop_period_s = period_s
        self.lead = CheckLead(SampleForm(side, self.kind))
        self._device = device
        self.run = StandaloneRun(
            device, self.lead, period_s=period_s, rest_by="stop" if side == "slave" else None, stopped=stopped
        )
        self.ended = True
        """True if the run ended before `end` returned."""

    @property
    def form(self) -> SampleForm:
        """Form of the samples."""
        return self.lead.form

    def push(self, size: float, axis: int) -> Push:
        """Start a push that an operator requested within the last 2 s; it starts with the next sample.

        The push ends by itself.

        Raises:
            ValueError: The device is an arm, the axis does not exist, or the push exceeds its bound.
        """
        if not 0 <= axis < (self.form.axes or 0):
            message = f"push-axis = {axis}: must be 0 to {(self.form.axes or 1) - 1}"
            raise ValueError(message)
        push = Push(size, axis, self.kind)
        self.lead.request(push)
        return push

    def end(self) -> None:
        """End the run and close the device."""
        self.ended = self.run.end()

    @property
    def messages(self) -> list[str]:
        """Return the driver's own texts of its errors."""
        return [*messages(self.run.watched.failed), *self.form.faults, "; ".join(self.form.faults)]

    def timing(self) -> Timing | None:
        """Return the timing of the loop."""
        return timing(self.run.ticks)

    def findings(self) -> list[Finding]:
        """Return the findings of a run that has ended."""
        found = [*_opening(self), check_kinds(self._device)]
        if not self.run.is_open:
            return found
        found += self._axes()
        found += self.form.findings()
        ticks, paces, said_s = self.run.ticks, self.run.watched.paces, self.run.period_s
        of = self.timing()
        found += [
            check_period(of, paces=paces, said_s=said_s, loop_s=self.loop_period_s),
            check_blocking(ticks, paces=paces, said_s=said_s),
        ]
        found += self._series()
        if self.form.faults:
            found.append(Finding("faults", "mend", f"the device reports: {'; '.join(self.form.faults)}"))
        found += self._calls()
        if self.lead.push is not None:
            found.append(self._pushed(self.lead.push))
        return found

    @property
    def _seen_period_s(self) -> float:
        """Period of the loop in s. A device that paces the loop has its measured period."""
        times = self.timing()
        return times.period_p50_s if self.run.watched.paces and times is not None else self.loop_period_s

    @property
    def _period_key(self) -> str:
        return "[run] period_s" if self.form.side == "master" else "[slave] period_s"

    def _axes(self) -> list[Finding]:
        axes = getattr(self._device, "axes", None)
        if axes is None or self.form.axes is None:
            return []
        if axes != self.form.axes:
            return [Finding("axes", "mend", f"axes = {axes!r}, but a sample has {self.form.axes}: must be as many")]
        return [Finding("axes", "pass", str(axes))]

    def _series(self) -> list[Finding]:
        time_s, readings = readings_of(self.run.ticks, self.lead.readings)
        if not readings:
            return []
        position = np.array([reading.position for reading in readings])
        speed_bound: float | None = getattr(self._device, "speed_bound", None)
        found = [
            *check_positions(time_s, position, self.kind, speed_bound),
            check_motion(position, self.kind),
            check_renewal(time_s, readings, self._seen_period_s, self._period_key),
        ]
        for name, check in (("velocity", check_velocity), ("force", None)):
            values = [getattr(reading, name) for reading in readings]
            if any(value is None for value in values):
                continue
            array = np.array(values)
            found.append(
                check_force(array, position, self.kind) if check is None else check(time_s, position, array, self.kind)
            )
        turns = [(reading.orientation, reading.angular_velocity) for reading in readings]
        if all(part is not None for turn in turns for part in turn):
            orientation, angular = (np.array([turn[index] for turn in turns]) for index in range(2))
            found.append(check_angular_velocity(time_s, orientation, angular))
        return found

    def _calls(self) -> list[Finding]:
        """Return how the driver's calls ended."""
        run, found = self.run, []
        for method in ("read", "write", "write_trigger"):
            if method in run.watched.failed:
                found.append(Finding(f"{method}()", "mend", raised(run.watched.failed[method])))
            elif not self.ended and run.failed_at == method:
                found.append(Finding(f"{method}()", "mend", "does not return: nobody can take the device's force away"))
            elif count := _calls_of(run, method):
                found.append(Finding(f"{method}()", "pass", f"{count} calls"))
        if run.error is not None and not run.watched.failed:
            found.append(Finding("samples", "mend", run.error.brief))
        found += [_rest(self), _closing(run, ended=self.ended)]
        return found

    def _pushed(self, push: Push) -> Finding:
        of = bounds_of(self.kind)
        unit = "N m" if self.kind == "joints" else "N"
        text = f"{push.size:g} {unit} along axis {push.axis}: went {1e3 * push.farthest:+.1f} m{of.unit}"
        text += f"; {push.ended}" if push.ended != "ended by itself" else ""
        if push.begun_s is None or push.ended is None:
            return Finding("push", "unseen", f"did not take place: {push.ended or 'the run ended before'}")
        if push.farthest < -0.5 * of.motion:
            return Finding("push", "mend", f"{text}: a positive force must push along +x: turn the sign of the force")
        if push.farthest > 0.5 * of.motion:
            return Finding("push", "pass", text)
        return Finding("push", "unseen", f"{text}: held fast, or no force?")


def _calls_of(run: StandaloneRun, method: str) -> int:
    """Return how often a per-tick method was called."""
    if method == "write_trigger":
        return 0
    return len(run.ticks) if method == "read" else sum(tick.force is not None for tick in run.ticks)


def _opening(check: DeviceCheck) -> list[Finding]:
    watched, error = check.run.watched, check.run.error
    if "open" in watched.failed:
        return [Finding("open()", "mend", raised(watched.failed["open"])), *_closed(check)]
    if check.ended and error is not None and not check.run.is_open:
        # The driver opened, and `opened` refused its period.
        opened = Finding("open()", "pass", f"took {watched.took_s['open']:.2f} s")
        return [opened, Finding("period", "mend", error.brief), *_closed(check)]
    if not check.run.is_open:
        return [Finding("open()", "mend", "does not return: nothing can be said of the rest"), *_closed(check)]
    return [Finding("open()", "pass", f"took {watched.took_s['open']:.2f} s")]


def _closed(check: DeviceCheck) -> list[Finding]:
    """Return the finding for a device that did not open; it must be closed nevertheless."""
    return [_closing(check.run, ended=True)] if "close" in check.run.watched.failed else []


def _rest(check: DeviceCheck) -> Finding:
    run = check.run
    name = "stop at the end" if check.form.side == "slave" else "zero at begin and end"
    if not check.ended:
        return Finding(name, "mend", f"the driver does not return from {run.failed_at}(): {KEEPS.rstrip(': ')}")
    if run.rests is None:
        return Finding(name, "unseen", "nothing was written, for no sample could be taken")
    if not run.rests:
        return Finding(
            name, "mend", f"{KEEPS}{'stop()' if check.form.side == 'slave' else 'write()'} raises at the end"
        )
    if check.form.side == "slave":
        return Finding(name, "pass", "stop() was taken; the arm was not moved")
    return Finding(name, "pass", "zero was taken at every sample but those of a push, and at the end")


def _closing(run: StandaloneRun, *, ended: bool) -> Finding:
    if "close" in run.watched.failed:
        text = f"{raised(run.watched.failed['close'])}: must release what it can"
        return Finding("close()", "mend", text)
    took_s = run.watched.took_s.get("close")
    if took_s is None:
        return Finding("close()", "mend", f"{'was not called' if ended else 'does not return'}")
    if took_s > (limit_s := CLOSE_S + lowering_s(run.watched)):
        return Finding("close()", "mend", f"took {took_s:.1f} s: must be at most {limit_s:g} s")
    return Finding("close()", "pass", f"took {took_s:.2f} s")


@dataclass
class _Interrupted:
    """Lead that raises an exception after a few samples, to simulate an error within a tick."""

    first: CheckLead
    ticks: int = 0
    lead: CheckLead = field(init=False)

    def __post_init__(self) -> None:
        self.lead = CheckLead(SampleForm(self.first.form.side, self.first.form.kind))

    def step(self, sample: object, at_s: float) -> Written | None:
        self.ticks += 1
        if self.ticks > SECOND_TICKS:
            message = "an exception in the middle of the loop, as the check means it to be"
            raise RuntimeError(message)
        return self.lead.step(sample, at_s)


class SecondRun:
    """Second run: reopen the driver after its close, and raise an exception in the middle of the loop."""

    def __init__(self, device: object, check: DeviceCheck, stopped: Callable[[], bool]) -> None:
        rest_by: RestBy | None = "stop" if check.form.side == "slave" else None
        self._lead = _Interrupted(check.lead)
        self.run = StandaloneRun(device, self._lead, period_s=check.loop_period_s, rest_by=rest_by, stopped=stopped)

    def finding(self) -> Finding:
        """End the second run and return its finding."""
        name = "close after an exception"
        ended = self.run.end()
        failed = self.run.watched.failed
        if failed:
            method, error = next(iter(failed.items()))
            return Finding(name, "mend", f"when it is opened again, {method}() {raised(error)}")
        if not ended or not self.run.is_open or "close" not in self.run.watched.took_s:
            return Finding(name, "mend", f"when it is opened again, {self.run.failed_at or 'open'}() does not return")
        if self.run.rests is False:
            return Finding(name, "mend", f"{KEEPS}after an exception it is not brought to rest")
        return Finding(name, "pass", "opened again, brought to rest after an exception, and closed")
