"""Gripper driver check: open, hold, read and close, without any write."""

from collections.abc import Callable

import numpy as np

from haptether.bridge.devices.check.finding import Finding, messages, raised
from haptether.bridge.devices.open import CLOSE_S
from haptether.bridge.devices.standalone import StandaloneRun
from haptether.slave import GripperSample

PERIOD_S = 0.01
"""Loop period in s; the driver must read at the arm's rate without blocking."""
MAX_CALL_S = 0.005
"""Limit in s for the 99th percentile of `read` and `hold`, because the arm loop calls them."""
ONE_STEP = 1.0 / 255.0
"""Resolution of common grippers; smaller changes do not count as motion."""


class GripperLead:
    """Store the samples of a gripper; write nothing."""

    def __init__(self) -> None:
        self.samples: list[GripperSample] = []
        self.wrong: str | None = None
        """First value returned by `read` that is not a sample."""
        self.faults: list[str] = []

    def step(self, sample: object, at_s: float) -> None:  # noqa: ARG002  # of the protocol of a lead
        """Take a sample."""
        if not isinstance(sample, GripperSample):
            self.wrong = self.wrong or f"read() gives {type(sample).__name__}: must be a GripperSample"
            return
        self.samples.append(sample)
        if sample.fault is not None and sample.fault not in self.faults:
            self.faults.append(sample.fault)


class GripperCheck:
    """Gripper driver under check; the only command sent to the jaws is hold.

    Args:
        gripper: Driver from `load_gripper`.
        stopped: Additional condition that ends the run.
    """

    def __init__(self, gripper: object, stopped: Callable[[], bool] = lambda: False) -> None:
        self.lead = GripperLead()
        self.run = StandaloneRun(gripper, self.lead, period_s=PERIOD_S, rest_by="hold", stopped=stopped)
        self.ended = True
        """True if the run ended before `end` returned."""

    def end(self) -> None:
        """End the run: hold the jaws and close the gripper."""
        self.ended = self.run.end()

    @property
    def status(self) -> str:
        """Return the current state of the jaws."""
        blocked = self.run.blocked_in(0.5)
        if blocked is not None:
            return f"{blocked}() has not returned for 0.5 s"
        if not self.lead.samples:
            return "no sample yet"
        sample = self.lead.samples[-1]
        holds = ", holds something" if sample.holds_object else ""
        fault = f", {sample.fault}" if sample.fault is not None else ""
        return f"closed to {sample.position:.3f}, {sample.velocity:+.3f} 1/s, {sample.force_n:.1f} N{holds}{fault}"

    @property
    def messages(self) -> list[str]:
        """Return the driver's own texts of its errors."""
        return [*messages(self.run.watched.failed), *self.lead.faults]

    def findings(self) -> list[Finding]:
        """Return the findings of a run that has ended."""
        run = self.run
        failed, took_s = run.watched.failed, run.watched.took_s
        if "open" in failed:
            return [Finding("open()", "mend", raised(failed["open"]))]
        if not run.is_open:
            return [Finding("open()", "mend", "does not return: nothing can be said of the rest")]
        found = [Finding("open()", "pass", f"took {took_s['open']:.2f} s")]
        found += [*self._reads(), self._at_rest()]
        if "close" in failed:
            found.append(Finding("close()", "mend", raised(failed["close"])))
        elif (closed_s := took_s.get("close")) is None:
            found.append(Finding("close()", "mend", "does not return"))
        elif closed_s > CLOSE_S:
            found.append(Finding("close()", "mend", f"took {closed_s:.1f} s: must be at most {CLOSE_S:g} s"))
        else:
            found.append(Finding("close()", "pass", f"took {closed_s:.2f} s"))
        return found

    def _reads(self) -> list[Finding]:
        run, lead = self.run, self.lead
        if "read" in run.watched.failed:
            return [Finding("read()", "mend", raised(run.watched.failed["read"]))]
        if not self.ended and run.failed_at == "read":
            return [Finding("read()", "mend", "does not return: the loop of the arm would wait for it")]
        if lead.wrong is not None:
            return [Finding("samples", "mend", lead.wrong)]
        if not lead.samples:
            return [Finding("samples", "unseen", "none was read")]
        taken_s = float(np.percentile([tick.read_s - tick.asked_s for tick in run.ticks], 99))
        text = f"{len(run.ticks)} calls, p99 {1e3 * taken_s:.3f} ms"
        too_slow = taken_s > MAX_CALL_S
        text += f": must be at most {1e3 * MAX_CALL_S:g} ms, the newest sample at once" if too_slow else ""
        found = [Finding("read()", "mend" if too_slow else "pass", text)]
        positions = [sample.position for sample in lead.samples]
        least, most = min(positions), max(positions)
        if most - least > ONE_STEP:
            found.append(Finding("position", "note", f"moved from {least:.3f} to {most:.3f}: nothing was commanded"))
        else:
            found.append(Finding("position", "pass", f"{positions[-1]:.3f} of 0 (open) to 1 (closed)"))
        if lead.faults:
            found.append(Finding("faults", "mend", f"the gripper reports: {'; '.join(lead.faults)}"))
        return found

    def _at_rest(self) -> Finding:
        run = self.run
        if not self.ended:
            return Finding("hold at the end", "mend", f"the driver does not return from {run.failed_at}()")
        if not run.rests:
            return Finding("hold at the end", "mend", "hold() raises: the jaws may go on as they were sent")
        took_s = run.watched.took_s.get("hold", 0.0)
        text = f"took {1e3 * took_s:.2f} ms"
        if took_s > MAX_CALL_S:
            return Finding("hold at the end", "mend", f"{text}: must return at once")
        return Finding("hold at the end", "pass", text)
