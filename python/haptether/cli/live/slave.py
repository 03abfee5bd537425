"""`haptether slave`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from haptether.cli.live.options import LiveOptions

if TYPE_CHECKING:
    from haptether.bridge import LoopReport, SlaveRun, SlaveTrace
    from haptether.cli.live.run import Cause


@dataclass(frozen=True, kw_only=True)
class Slave(LiveOptions):
    """Run the side of the robot: a simulated position-controlled arm in front of a wall.

    The arm starts 0.02 m in front of the wall (at x = 0, which fills x < 0). Times count from the moment the
    two sides engage. When the master falls silent for 20 ms the arm holds, and after 200 ms it stops, until the
    master's clutch is released and pressed again or a master is started anew. One master has the lease until it
    ends; when it has vanished without an end, `kill -USR1` lets another begin after 2 s of silence. After a fault of
    this side `kill -USR2` says that it is mended.

    Exit status 1 says that no master came in time, that this side ended in a fault, or that its driver failed; how the
    master ended does not count.

    Examples:

    haptether slave --listen 127.0.0.1:9000 --key arm.key

    haptether slave --listen 127.0.0.1:9000 --key arm.key --wall-stiffness 100 --push-at-s 2 --push-force-n 3.5

    haptether slave --listen 127.0.0.1:9000 --key arm.key --scene three_axis_box
    """

    listen: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where to listen; answers go where the master's frames come from."""
    key: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Key file of the secure session, the same at both sides; `haptether keygen` makes one."""
    insecure: bool = False
    """Go without a key: frames travel in the clear, and anybody who can send can steer."""
    wall_stiffness: float = 100.0
    """Stiffness of the wall in N/m."""
    push_at_s: float | None = None
    """When something shoves the arm, in s; never if not given."""
    push_force_n: float = 3.5
    """With which force in N, positive towards the hand; it rises within 0.5 s."""
    push_duration_s: float = 2.0
    """For how long in s."""
    duration_s: float | None = None
    """End this long after engaging, in s; without it, run until Ctrl-C."""
    patience_s: float | None = None
    """Give up if no master has come after this time in s; without it, wait for one."""
    flight: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the last states and commands at a stop, at a fault and at the end; `haptether explain` prints them."""
    keep_s: float = 600.0
    """How much of the end of the run the figures hold, in s; its memory is taken at the start."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the result as JSON at the end; - for standard output."""

    def run(self) -> int:
        """Runs until told to stop."""
        import numpy as np

        from haptether.bridge import LiveSlave
        from haptether.cli.live.run import (
            FlightFile,
            Steps,
            Stopped,
            acknowledge,
            check_memory,
            recording_status,
            tell,
            wait,
        )
        from haptether.cli.live.security import handed_over, marked, session_key
        from haptether.cli.live.sides import fault_text, live_scene, raise_error, start_slave
        from haptether.cli.shared.options import new_session, slave_settings
        from haptether.cli.shared.output import check_distinct, check_target
        from haptether.safety import fault_message

        check_target(self.json)
        check_target(self.flight)
        check_distinct(key=self.key, json=self.json, flight=self.flight, record=self.record)
        key = session_key(self.key, insecure=self.insecure)
        flight = FlightFile(self.flight)
        live = self.live()
        scene = live_scene(
            self, self.scene, self.set, ("wall_stiffness", "push_at_s", "push_force_n", "push_duration_s")
        )
        how: dict[str, Any] = {
            "listen": self.listen,
            "session": new_session(),
            "key": key,
            "insecure": self.insecure,
            "duration_s": self.duration_s,
            "patience_s": self.patience_s,
            "keep_s": self.keep_s,
            **live,
        }
        with Stopped() as stopped:
            slave: LiveSlave | SlaveRun
            if scene is not None:
                slave = start_slave(scene, stopped, **how)
            else:
                settings = slave_settings(
                    wall_stiffness=self.wall_stiffness,
                    push_at_s=self.push_at_s,
                    push_force_n=self.push_force_n,
                    push_duration_s=self.push_duration_s,
                )
                slave = stopped.attached(LiveSlave(settings, **how))
            handed_over(key)

            steps = Steps("slave")

            def status() -> str:
                slave.poll()
                acknowledge(slave, stopped)
                tell(slave.security_events())
                steps.show(slave)
                flight.write(slave.flight())
                shown = (
                    f"slave {slave.state}, {slave.ticks} ticks{fault_text(slave)}{recording_status(slave.recording)}"
                )
                return marked(shown, insecure=self.insecure)

            headline = marked(f"slave listens on {slave.address}", insecure=self.insecure)
            headline += f"\nreal time: {slave.realtime}"
            wait(headline, status, lambda: slave.finished, stopped, None)
            trace, report = slave.finish()
            check_memory(report)
            tell(slave.security_events())
            flight.write(slave.flight())
            cause = steps.cause_at_end(slave)
        state = self._report(trace, report, cause)
        raise_error(slave)
        if state == "fault":
            said = cause.text if cause is not None else fault_message(int(trace.fault[-1]))
            raise RuntimeError(f"the run ended in fault: {said}")
        if not np.isfinite(report.engaged_s) and not stopped:
            raise RuntimeError(f"no master came within {self.patience_s} s")
        return 0

    def _report(self, trace: "SlaveTrace", report: "LoopReport", cause: "Cause | None") -> str:
        import msgspec
        import numpy as np

        from haptether.bridge import ladder_state_name
        from haptether.cli.link_table import link_table
        from haptether.cli.shared.output import write_json
        from haptether.cli.shared.screen import screen
        from haptether.studies import summarise_link

        state = ladder_state_name(int(trace.state[-1])) if len(trace) else "disengaged"
        link = summarise_link(trace, report)
        engaged = len(trace) > 0 and bool(np.isfinite(report.engaged_s))
        result = {
            "security": "secure" if report.secure else "insecure",
            "final_state": state,
            "ticks": report.ticks,
            "skipped_ticks": report.skipped,
            "holds": report.holds,
            "limited_commands": report.limited,
            "peak_environment_force_n": float(np.abs(trace.environment_force).max()) if engaged else None,
            "sent": report.link.sent,
            "lost": report.link.missing,
            "late": report.link.late,
            "refused": report.link.refused,
            "rejections": report.rejections,
            "overshoot_p50_s": link.overshoot_p50_s,
            "overshoot_p99_s": link.overshoot_p99_s,
            "cause": cause,
            "link": link,
        }
        console = screen(self.json)
        console.print(
            f"slave {state}: {report.ticks} ticks, {report.holds} holds, {report.limited} commands clamped, "
            f"sent {report.link.sent}, lost {report.link.missing}, late {report.link.late}",
            highlight=False,
        )
        if np.isfinite(trace.age_s).any():
            console.print(link_table(link))
        if self.json is not None:
            write_json(self.json, msgspec.json.format(msgspec.json.encode(result), indent=2))
        return state
