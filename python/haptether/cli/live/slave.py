"""`haptether slave`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.live.options import LiveOptions

if TYPE_CHECKING:
    from haptether.bridge import LoopReport, Scene, SlaveTrace
    from haptether.bridge.flight import Cause


@dataclass(frozen=True, kw_only=True)
class Slave(LiveOptions):
    """Run the side of the robot: a simulated position-controlled arm in front of a wall.

    The arm starts 0.02 m in front of the wall (at x = 0, which fills x < 0). Times count from the moment the two sides
    engage. When the master falls silent for 20 ms the arm holds, and after 200 ms it stops, until the master's clutch
    is released and pressed again or a master is restarted. One master has the lease until it ends. If it has vanished
    without an end, `kill -USR1` lets another begin after 2 s of silence. After a fault of this side, acknowledge with
    `kill -USR2` that it is mended.

    Exit status 1: no master came in time, this side ended in a fault, or its driver failed; the end of the master does
    not count.

    Examples:

    haptether slave --listen 127.0.0.1:9000 --key arm.key

    haptether slave --listen 127.0.0.1:9000 --key arm.key --wall-stiffness 100 --push-at-s 2 --push-force-n 3.5

    haptether slave --listen 127.0.0.1:9000 --key arm.key --scene three_axis_box
    """

    listen: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Address to listen on; answers go to the source of the master's frames."""
    wall_stiffness: float = 100.0
    """Stiffness of the wall in N/m."""
    push_at_s: float | None = None
    """Time in s at which something shoves the arm; never if not given."""
    push_force_n: float = 3.5
    """Force of the shove in N, positive towards the hand; it rises within 0.5 s."""
    push_duration_s: float = 2.0
    """Duration of the shove in s."""
    duration_s: float | None = None
    """End this long after the first engagement, in s; without it, run until Ctrl-C. The wait for a master does not
    count: --patience-s bounds it."""
    patience_s: float | None = None
    """Give up if no master has come after this time in s; without it, wait for one."""
    keep_s: float | None = None
    """Time in s at the end of the run that the figures hold; its memory is taken at the start. By default 16 MiB: 174 s
    along one axis, 72 s of poses."""

    def run(self) -> int:
        """Run until it is stopped."""
        from haptether.cli.live.sides import baseline_scene, live_scene

        options = ("wall_stiffness", "push_at_s", "push_force_n", "push_duration_s")
        if (scene := live_scene(self, options)) is None:
            scene = baseline_scene(**{name: getattr(self, name) for name in options})
            for name in ("push_force_n", "push_duration_s"):
                if self.push_at_s is None and getattr(self, name) != getattr(Slave, name):
                    message = f"{name} = {getattr(self, name):g}: nothing pushes: give --push-at-s, or leave it out"
                    raise ValueError(message)
        return self.run_scene(scene)

    def run_scene(self, scene: "Scene") -> int:
        """Run a scene."""
        import numpy as np

        from haptether.cli.live.options import handed_over, live_arguments, session_key
        from haptether.cli.live.panel_process import panel_process
        from haptether.cli.live.run import FlightFile, SideWatch, print_kept
        from haptether.cli.live.sides import start_slave
        from haptether.cli.shared.output import check_distinct, check_target
        from haptether.cli.shared.stop import Stopped
        from haptether.safety import fault_message

        check_target(self.json, self.flight, force=self.force)
        check_distinct(key=self.key, json=self.json, flight=self.flight, record=self.record)
        key = session_key(self.key, insecure=self.insecure)
        flight = FlightFile(self.flight)
        arguments = {
            **live_arguments(self, key),
            "listen": self.listen,
            "duration_s": self.duration_s,
            "patience_s": self.patience_s,
            "keep_s": self.keep_s,
        }
        with panel_process(arguments["telemetry"], quiet=self.quiet) as panel, Stopped() as stopped:
            slave = start_slave(scene, stopped, arguments)
            handed_over(key)
            watch = SideWatch("slave", slave, stopped, flight, insecure=self.insecure)
            watch.until_end(f"slave listens on {slave.address}{self._ending()}", panel, quiet=self.quiet)
            trace, report = slave.finish()
            cause = watch.after_end(report)
        state = self._report(trace, report, cause)
        print_kept(trace, report)
        watch.raise_error()
        if state == "fault":
            reason = cause.text if cause is not None else fault_message(int(trace.fault[-1]))
            raise RuntimeError(f"the run ended in fault: {reason}")
        if not np.isfinite(report.engaged_s) and not stopped:
            raise RuntimeError(f"no master came within {self.patience_s} s")
        return 0

    def _ending(self) -> str:
        """Return the headline's remark on the end, if it may come later than expected."""
        if self.duration_s is None or self.patience_s is not None:
            return ""
        return f", waits for a master, and ends {self.duration_s:g} s after engaging; --patience-s bounds the wait"

    def _report(self, trace: "SlaveTrace", report: "LoopReport", cause: "Cause | None") -> str:
        import numpy as np

        from haptether.bridge import ladder_state_name
        from haptether.cli.shared.link_table import link_table
        from haptether.cli.shared.output import write_report
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
            "outliers": report.outliers,
            "renewal": report.renewal,
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
        renewed = "" if report.renewal is None else f", new ones at {100.0 * report.renewal:.0f} % of the ticks"
        console.print(
            f"slave {state}: {report.ticks} ticks, {report.holds} holds, {report.limited} commands clamped, "
            f"{report.outliers} samples replaced{renewed}, "
            f"sent {report.link.sent}, lost {report.link.missing}, late {report.link.late}",
            highlight=False,
        )
        if np.isfinite(trace.age_s).any():
            console.print(link_table(link))
        write_report(self.json, result)
        return state
