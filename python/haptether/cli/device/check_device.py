"""`haptether check-device`."""

import math
import sys
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from haptether.cli.device.options import DriverOptions

if TYPE_CHECKING:
    from haptether.bridge.devices.check.finding import Finding
    from haptether.bridge.devices.check.report import DeviceCheck
    from haptether.cli.shared.screen import Screen
    from haptether.cli.shared.stop import Stopped

MAX_DURATION_S = 600.0
RECENT = 200
"""Samples whose rate is shown."""


@dataclass(frozen=True, kw_only=True)
class CheckDevice(DriverOptions):
    """Open the driver of a device by itself, and say what is right with it and what is to be mended.

    A haptic device gets zero force all the time, an arm is not moved, and the jaws of a gripper are held. Nothing is
    coupled: there is no other side. Move the device by hand along every axis while it runs; an axis that does not move
    shows no velocity. The device is opened a second time, to check that it is closed after an exception. The loop runs
    in real time where the system permits it. Some devices exert force as soon as they are open, such as a leader arm
    against its weight. They are opened only after a person's yes on the terminal, and so is a gripper that is to be
    activated.

    --push-n makes a haptic device push once, with at most 1 N (0.1 N m of joints), up and down a ramp within 1.5 s. A
    person is asked on the terminal first. Ctrl-C, a motion too far or too fast, a late sample or a fault ends it at
    once.

    Exit status 0: nothing is to be mended; 1: something is.

    Examples:

    haptether check-device ur --options host=192.168.1.10

    haptether check-device my-stylus --duration-s 20 --push-n 0.5
    """

    side: Literal["master", "slave", "gripper"] | None = None
    """Side of the driver, where several have this name."""
    duration_s: float = 5.0
    """Duration of the check in s, at most 600."""
    push_n: float | None = None
    """Push once with this force in N (joints: N m), after a person's yes, for a haptic device; 0.5 is felt."""
    push_axis: int = 0
    """Axis of the push."""
    yes: bool = False
    """Do not ask before the push, nor before opening a device that exerts by itself. Give this flag only while standing
    beside the device and holding it."""

    def run(self) -> int:
        """Check the device and print the findings.

        Raises:
            ValueError: No such driver, or an option out of its bounds.
        """
        from haptether.bridge.devices.check.finding import Finding
        from haptether.bridge.devices.check.report import DeviceCheck, kind_of
        from haptether.bridge.devices.open import KEEPS
        from haptether.cli.device.consent import announced, ask_before_open
        from haptether.cli.device.options import (
            await_open,
            certain_kind,
            check_options,
            is_over,
            loaded_device,
            show_tracebacks,
            side_of,
        )
        from haptether.cli.device.told import listening
        from haptether.cli.shared.own_force import exerts_by_itself
        from haptether.cli.shared.stop import Stopped, wait

        check_options(self)
        side = side_of(self.name, self.side)
        self._check(side)
        if side == "gripper":
            return check_gripper(self)
        with Stopped() as stopped, listening() as told:
            device = loaded_device(self, side)
            kind = self.kind or kind_of(device)
            if self.push_n is not None:
                self._check_push(certain_kind(self, device))
            ask_before_open(self.name, device, stopped, yes=self.yes)
            found: list[Finding] = []
            unpushed = None
            with announced(self.name, device) as runs:
                check = DeviceCheck(device, side, kind, period_s=self.period_s, stopped=lambda: bool(stopped))
                runs.append(check.run)
                if await_open(self, check.run, stopped):
                    headline = f"{self.name}: open, a {side} of kind {check.kind}; "
                    zero = "zero force beside its own" if exerts_by_itself(device) else "zero force"
                    headline += f"{zero}: move it along every axis" if side == "master" else "it is not moved"
                    wait(headline, lambda: _status(check), lambda: is_over(check.run), stopped, self.duration_s)
                    if self.push_n is not None and not is_over(check.run):
                        unpushed = self._push(check, stopped)
                check.end()
            if stopped:
                if not check.ended:
                    print(f"{self.name}: the driver does not return: {KEEPS.rstrip(': ')}", file=sys.stderr, flush=True)
                # A check that was cut short gives no verdict.
                raise KeyboardInterrupt
            found += check.findings()
            said = check.messages
            if unpushed is not None:
                found.append(Finding("push", "unseen", unpushed))
            show_tracebacks(self, check.run)
            if check.run.is_open and check.run.error is None and check.ended and not stopped:
                again, texts = self._again(check, side, stopped)
                found.append(again)
                said += texts
            if stopped:
                raise KeyboardInterrupt
        self._report(check, side, found, told.shortened(found, said))
        return 1 if any(finding.verdict == "mend" for finding in found) else 0

    def _again(
        self, check: "DeviceCheck", side: Literal["master", "slave"], stopped: "Stopped"
    ) -> "tuple[Finding, list[str]]":
        """Open the device again and end that run by an exception; return the finding and the driver's error texts."""
        from haptether.bridge import DeviceError
        from haptether.bridge.devices.check.finding import Finding, messages
        from haptether.bridge.devices.check.report import SecondRun
        from haptether.bridge.devices.standalone import wait_until
        from haptether.cli.device.consent import announced, ask_before_open
        from haptether.cli.device.options import await_open, loaded_device, show_tracebacks

        name = "close after an exception"
        try:
            device = loaded_device(self, side)
        except (DeviceError, ValueError) as error:
            return Finding(name, "mend", f"it cannot be made a second time: {error}"), []
        try:
            # Ask again: the person who held it has meanwhile read that its force has ended.
            ask_before_open(self.name, device, stopped, yes=self.yes, again=True)
        except RuntimeError as error:
            return Finding(name, "unseen", str(error)), []
        with announced(self.name, device) as runs:
            second = SecondRun(device, check, lambda: bool(stopped))
            runs.append(second.run)
            await_open(self, second.run, stopped)
            wait_until(lambda: second.run.finished or bool(stopped), 5.0)
            found = second.finding()
        show_tracebacks(self, second.run)
        return found, messages(second.run.watched.failed)

    def _check(self, side: str) -> None:
        """Refuse invalid options before anything is opened."""
        from haptether.cli.device.consent import check_terminal

        if not 0.1 <= self.duration_s <= MAX_DURATION_S:
            message = f"duration-s = {self.duration_s:g}: must be between 0.1 and {MAX_DURATION_S:g} s"
            raise ValueError(message)
        if self.push_n is None:
            return
        if side != "master":
            what = "an arm is never moved" if side == "slave" else "jaws are never moved"
            message = f"push-n = {self.push_n:g}: {what} by check-device: leave it out"
            raise ValueError(message)
        if not (math.isfinite(self.push_n) and self.push_n > 0.0):
            message = f"push-n = {self.push_n:g}: must be above 0"
            raise ValueError(message)
        if not 0 <= self.push_axis <= 6:
            message = f"push-axis = {self.push_axis}: must be 0 to 6"
            raise ValueError(message)
        check_terminal(f"push-n = {self.push_n:g}", yes=self.yes)

    def _check_push(self, kind: str) -> None:
        from haptether.bridge.devices.check.push import MAX_PUSH

        if self.push_n is not None and self.push_n > MAX_PUSH[kind]:
            unit = "N m" if kind == "joints" else "N"
            message = f"push-n = {self.push_n:g}: must be at most {MAX_PUSH[kind]:g} {unit} for kind {kind}"
            raise ValueError(message)

    def _push(self, check: "DeviceCheck", stopped: "Stopped") -> str | None:
        """Ask, then push; return why the device did not push."""
        from haptether.cli.device.consent import consents
        from haptether.cli.device.options import is_over
        from haptether.cli.shared.stop import wait

        assert self.push_n is not None
        axes = check.form.axes
        if axes is None or self.push_axis >= axes:
            return f"axis {self.push_axis}: there is {'no sample' if axes is None else f'0 to {axes - 1}'}"
        unit = "N m" if check.kind == "joints" else "N"
        question = (
            f"{self.name} will push with {self.push_n:g} {unit} along axis {self.push_axis} for 1.5 s. Hold it loosely;"
            " Ctrl-C ends it."
        )
        if not consents(question, stopped, yes=self.yes) or stopped:
            return "nobody said yes"
        push = check.push(self.push_n, self.push_axis)
        wait("pushing", lambda: _status(check), lambda: push.ended is not None or is_over(check.run), stopped, 5.0)
        return None

    def _report(self, check: "DeviceCheck", side: str, found: "list[Finding]", table: "list[Finding]") -> None:
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.screen import screen

        console = screen(self.json)
        print_findings(console, self.name, table)
        times = check.timing()
        if times is not None:
            rows = {
                "period": (times.period_p50_s, times.period_p99_s, times.period_max_s),
                "read()": (times.read_p50_s, times.read_p99_s, times.read_max_s),
                "write()": (times.write_p50_s, times.write_p99_s, times.write_max_s),
            }
            for name, values in rows.items():
                shown = " / ".join(f"{1e3 * value:.3f}" for value in values)
                console.print_item(f"{name}, p50 / p99 / max [ms]: {shown}")
            without = "" if check.run.has_real_time else ", without real time: the system does not give it"
            console.print(f"rate: {times.rate_hz:.1f} Hz{without}")
        wrong = print_verdict(console, found)
        write_report(
            self.json,
            {
                "driver": self.name,
                "side": side,
                "kind": check.kind,
                "axes": check.form.axes,
                "passed": not wrong,
                "findings": found,
                "timing": times,
                "real_time": check.run.has_real_time,
            },
        )


def print_findings(console: "Screen", name: str, found: "list[Finding]") -> None:
    """Print one line a property."""
    from haptether.cli.shared.table import Rows

    table = Rows("", "check", f"{name}: what was seen", keys=2)
    for finding in found:
        verdict = finding.verdict.upper() if finding.verdict == "mend" else finding.verdict
        table.add(verdict, finding.check, finding.text)
    console.print(table)


def print_verdict(console: "Screen", found: "list[Finding]") -> int:
    """Print the checks without a result and the verdict; return the number of findings to be mended."""
    wrong = sum(finding.verdict == "mend" for finding in found)
    unseen = [finding.check for finding in found if finding.verdict == "unseen"]
    if unseen:
        console.print_item(f"not seen: {', '.join(unseen)}")
    console.print("pass" if not wrong else f"{wrong} to mend")
    return wrong


def check_gripper(command: CheckDevice) -> int:
    """Open, hold, read and close a gripper, and print the findings.

    Raises:
        ValueError: No such driver, or a gripper that is opened with its arm.
        RuntimeError: Nobody said yes to an activation.
        KeyboardInterrupt: Ctrl-C.
    """
    from haptether.bridge import load_gripper
    from haptether.bridge.devices.check.gripper import GripperCheck
    from haptether.cli.device.consent import check_terminal, consents
    from haptether.cli.device.options import await_open, driver_options, is_over, show_tracebacks
    from haptether.cli.device.told import listening
    from haptether.cli.shared.output import write_report
    from haptether.cli.shared.screen import screen
    from haptether.cli.shared.stop import Stopped, wait

    name, options = command.name, driver_options(command, "gripper")
    gripper = load_gripper(name, options)
    if callable(getattr(gripper, "attach", None)):
        message = f"{name}: a gripper on the bus of its arm: it is opened with that, by `haptether slave`"
        raise ValueError(message)
    with Stopped() as stopped, listening() as told:
        if options.get("activate"):
            check_terminal("an activation moves the jaws", yes=command.yes)
            question = f"{name} will open and close its jaws once, and drops what they hold. No fingers between them."
            if not consents(question, stopped, yes=command.yes):
                message = f"{name}: not opened: nobody said yes"
                raise RuntimeError(message)
        check = GripperCheck(gripper, lambda: bool(stopped))
        if await_open(command, check.run, stopped):
            headline = f"{name}: open, a gripper: its jaws are held"
            wait(headline, lambda: check.status, lambda: is_over(check.run), stopped, command.duration_s)
        check.end()
        if stopped:
            raise KeyboardInterrupt
        show_tracebacks(command, check.run)
    found = check.findings()
    console = screen(command.json)
    print_findings(console, name, told.shortened(found, check.messages))
    wrong = print_verdict(console, found)
    write_report(command.json, {"driver": name, "side": "gripper", "passed": not wrong, "findings": found})
    return 1 if wrong else 0


def _status(check: "DeviceCheck") -> str:
    """Return the current position, velocity, force and rate."""
    ticks, readings = check.run.ticks, check.lead.readings
    blocked = check.run.blocked_in(0.5)
    if blocked is not None:
        return f"{blocked}() has not returned for 0.5 s"
    if not ticks or not readings:
        return "no sample yet"
    reading, tick = readings[-1], ticks[-1]
    if reading is None:
        return f"sample {len(readings)} is not one that the bridge takes"

    def of(values: tuple[float, ...] | None) -> str:
        return "-" if values is None else " ".join(f"{value:+.4f}" for value in values)

    recent = ticks[-RECENT:]
    age_s = recent[-1].read_s - recent[0].read_s
    rate = f"{(len(recent) - 1) / age_s:.0f} Hz" if age_s > 0.0 else "-"
    force = reading.force if tick.force is None else tick.force[0]
    late = "" if time.monotonic() - tick.read_s < 0.5 else ", no new sample"
    return f"x {of(reading.position)}  v {of(reading.velocity)}  F {of(force)}  {rate}{late}"
