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

    A haptic device is written zero force all the time, an arm is not moved, and the jaws of a gripper are held. Nothing
    is coupled: there is no other side. Move the device by hand while it runs, along every axis: what does not move
    shows no velocity. It is opened a second time, to see that it is closed after an exception. Its loop has real time
    where the system gives it. One that exerts by itself as soon as it is open, such as a leader arm against its weight,
    is opened only after a person's yes on the terminal, and so is a gripper that is to be activated.

    --push-n has a haptic device push once, with at most 1 N (0.1 N m of joints), up and down a ramp within 1.5 s. A
    person is asked on the terminal first. It ends at once by Ctrl-C, a motion too far or too fast, a late sample or a
    fault.

    Exit status 0 says that nothing is to be mended, 1 that something is.

    Examples:

    haptether check-device ur --options host=192.168.1.10

    haptether check-device my-stylus --duration-s 20 --push-n 0.5
    """

    side: Literal["master", "slave", "gripper"] | None = None
    """Which of these, where there are several by that name."""
    duration_s: float = 5.0
    """For how long it is looked at, in s, at most 600."""
    push_n: float | None = None
    """Have a haptic device push with this force in N (joints: N m) once, after a person's yes; 0.5 is felt."""
    push_axis: int = 0
    """Along which axis."""
    yes: bool = False
    """Do not ask before the push, nor before a device is opened that exerts by itself: whoever gives this flag stands
    beside the device, and holds it."""

    def run(self) -> int:
        """Checks, and says what was found.

        Raises:
            ValueError: A driver that there is not, or an option out of its bounds.
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
                # Of a part of what was requested there is no verdict.
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
        """Open it a second time, and has an exception end that run; also the driver's texts of what was wrong."""
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
            # Anew: whoever held it for the first time has read meanwhile that its force has ended.
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
        """Refuse what cannot be, before anything is opened."""
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
        """Asks, and has it push; returns why it did not."""
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
    """One line a property."""
    from haptether.cli.shared.table import Rows

    table = Rows("", "check", f"{name}: what was seen", keys=2)
    for finding in found:
        verdict = finding.verdict.upper() if finding.verdict == "mend" else finding.verdict
        table.add(verdict, finding.check, finding.text)
    console.print(table)


def print_verdict(console: "Screen", found: "list[Finding]") -> int:
    """What was not seen, and whether it passes; returns how many are to be mended."""
    wrong = sum(finding.verdict == "mend" for finding in found)
    unseen = [finding.check for finding in found if finding.verdict == "unseen"]
    if unseen:
        console.print_item(f"not seen: {', '.join(unseen)}")
    console.print("pass" if not wrong else f"{wrong} to mend")
    return wrong


def check_gripper(command: CheckDevice) -> int:
    """Opens, holds, reads and closes a gripper, and says what was found.

    Raises:
        ValueError: A driver that there is not, or one that is opened with its arm.
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
    """Position, velocity, force and rate of now."""
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
