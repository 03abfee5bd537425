"""`haptether master`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.live.options import Controller, LiveOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from haptether.bridge import MasterTrace, Scene
    from haptether.bridge.flight import Cause
    from haptether.cli.shared.screen import Screen
    from haptether.studies import LinkSummary, PushResult

TRACE_S = 600.0
"""Time in s at the end of a run that is kept if its ticks are written."""
ALONE_S = 0.2
"""A slave that ends at most this long before the master has ended with it, in s."""


@dataclass(frozen=True, kw_only=True)
class Master(LiveOptions):
    """Run the side of the hand: a simulated haptic device held by a simulated hand that can let go.

    Times count from the moment the two sides engage. Starting this command presses the clutch. A loop that begins more
    than 5 s later, on a device without a button, asks on the terminal for another press; without a terminal it ends. No
    press waits for more than 5 s: a slave that answers later needs another. When the slave falls silent for 20 ms, the
    force on the hand fades to zero within 75 ms. It stays away until the clutch is released and pressed again: `kill
    -USR1` does that, and so does --clutch auto. After a fault, first acknowledge with `kill -USR2` that it is mended.
    Figures and trace hold the last --keep-s.

    Exit status 1: the start was too long ago, no slave answered, a driver failed, or the run ended in fault. Without
    Ctrl-C it is also 1 for an end in hold, in stop or after the slave. If the two sides are not coupled, the screen
    names the cause, in the driver's own words, and the remedies in order.

    Examples:

    haptether master --peer 127.0.0.1:9000 --key arm.key --controller wsc

    haptether master --peer 127.0.0.1:9001 --key arm.key --release-at-s 2.6 --duration-s 3.4 --json run.json

    haptether master --peer 127.0.0.1:9000 --key arm.key --scene three_axis_box --set safety.controllers=[hsc]
    """

    peer: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Address of the slave, or of netsim before it."""
    controller: Controller = "wsc"
    """Safety controller: velocity and force (vfc), grasp (hsc), windowed energy (wsc), passivity (pc), or none. One of
    your own runs in `simulate`, `sweep` and `evaluate` only: docs/own_controller.md."""
    listen: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Own address, of the peer's kind (IPv4 or IPv6). By default that of the route to the peer, which is loopback for a
    peer on this machine, with a free port; 0.0.0.0:0 where the route may change during the run."""
    depth: float = 0.045
    """Depth in m of the hand's target inside the wall."""
    release_at_s: float | None = None
    """Time in s at which the hand lets go; never if not given."""
    force_scale: float = 1.0
    """Rendered force over the force that the slave measures."""
    encoder_quantum: float = 2.3e-5
    """Resolution of the device in m; 0 measures position and velocity exactly."""
    clutch: Literal["once", "open", "auto"] = "once"
    """Pressed at the start and held (once), open until somebody presses it (open), or worked by a simulated person who
    presses again 0.5 s after a hold (auto). A scene's "auto" counts only with --clutch auto, also for a device with a
    driver; otherwise only its button or SIGUSR1 presses the clutch."""
    duration_s: float | None = None
    """End this long after the first engagement, in s; without it, run until Ctrl-C."""
    patience_s: float = 10.0
    """Give up if the slave has not answered after this time in s."""
    keep_s: float | None = None
    """Time in s at the end of the run that figures and trace hold; its memory is taken at the start. By default 600 s
    with --trace, else 16 MiB: 87 s along one axis, 24 s of poses."""
    trace: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the ticks of the last --keep-s as NumPy arrays (.npz)."""

    def run(self) -> int:
        """Run until it is stopped; fail if the slave never answered."""
        import numpy as np

        from haptether.cli.live.options import handed_over, live_arguments, session_key
        from haptether.cli.live.panel_process import panel_process
        from haptether.cli.live.run import OLD_START, FlightFile, SideWatch, print_kept
        from haptether.cli.live.sides import baseline_scene, live_scene, start_master, with_clutch
        from haptether.cli.shared.numbers import check_duration
        from haptether.cli.shared.output import check_distinct, check_target
        from haptether.cli.shared.stop import Stopped
        from haptether.studies import measure_push, save_master_trace, summarise_link

        check_duration("duration_s", self.duration_s)
        check_target(self.json, self.trace, self.flight, force=self.force)
        check_distinct(key=self.key, json=self.json, trace=self.trace, flight=self.flight, record=self.record)
        key = session_key(self.key, insecure=self.insecure)
        flight = FlightFile(self.flight)
        arguments = {
            **live_arguments(self, key),
            "listen": self.listen,
            "peer": self.peer,
            "duration_s": self.duration_s,
            "patience_s": self.patience_s,
            "keep_s": TRACE_S if self.keep_s is None and self.trace is not None else self.keep_s,
        }
        options = ("controller", "depth", "release_at_s", "force_scale", "encoder_quantum")
        scene = live_scene(self, options) or baseline_scene(**{name: getattr(self, name) for name in options})
        scene = with_clutch(scene, self.clutch)
        controller, release_at_s = _protection(scene)
        with panel_process(arguments["telemetry"], quiet=self.quiet) as panel, Stopped() as stopped:
            master = start_master(scene, self.clutch, (self.scene, self.set), stopped, arguments)
            handed_over(key)
            press = None if self.clutch == "open" else master.press_clutch
            watch = SideWatch("master", master, stopped, flight, insecure=self.insecure, press=press)
            watch.until_end(f"master on {master.address} talks to {self.peer}", panel, quiet=self.quiet)
            trace, report = master.finish()
            cause = watch.after_end(report)
        result = measure_push(controller, trace, report, release_at_s)
        answered = bool(np.isfinite(trace.age_s).any())
        self._report(
            result, summarise_link(trace, report), cause, answered=answered, joints=scene.master.kind == "joints"
        )
        print_kept(trace, report)
        if self.trace is not None:
            save_master_trace(trace, self.trace)
        watch.raise_error()
        if watch.has_void_start:
            message = (
                f"{OLD_START}: start it again; where a start takes longer, give --clutch open and press later, by"
                " `kill -USR1` or the console"
            )
            raise RuntimeError(message)
        alone = result.final_state == "disengaged" and _uncoupled_s(trace) < ALONE_S
        answered = report.link.fresh > 0
        self._judge(result, answered=answered, stopped=bool(stopped) or alone, refused=watch.refused, cause=cause)
        return 0

    def _judge(
        self, result: "PushResult", *, answered: bool, stopped: bool, refused: str | None, cause: "Cause | None"
    ) -> None:
        """Raise the reason of a run that ended badly."""
        if result.final_state == "fault":
            message = f"the run ended in fault: {cause.text if cause is not None else result.fault}"
            raise RuntimeError(message)
        if stopped:
            return
        if result.engaged_s is None:
            raise RuntimeError(self._never_engaged(refused, cause, answered=answered))
        if cause is not None:
            message = f"the run ended in {result.final_state}: {cause.text}"
            raise RuntimeError(message)

    def _never_engaged(self, refused: str | None, cause: "Cause | None", *, answered: bool) -> str:
        if refused is not None:
            return f"no slave to steer at {self.peer}: {refused}"
        if not answered:
            return (
                f"no slave answered at {self.peer} within {self.patience_s:g} s: is it running there, free, and with"
                " the same key?"
            )
        if cause is not None:
            return f"the two sides never engaged: {cause.text}"
        return (
            f"the slave at {self.peer} answered, but the clutch was not pressed since: its button, or `kill -USR1`"
            " of the master, presses it again"
        )

    def _report(
        self, result: "PushResult", link: "LinkSummary", cause: "Cause | None", *, answered: bool, joints: bool
    ) -> None:
        import msgspec

        from haptether.cli.shared.link_table import link_table
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.screen import screen

        console = screen(self.json)
        # Without an engagement nothing was measured.
        if result.engaged_s is not None:
            print_push(console, [result], joints=joints)
        if answered:
            console.print(link_table(link))
        write_report(self.json, {**msgspec.to_builtins(result), "cause": cause, "link": link})


def _uncoupled_s(trace: "MasterTrace") -> float:
    """Return the time in s since the two sides were last coupled."""
    import numpy as np

    from haptether.bridge import ladder_state_name

    codes = [code for code in np.unique(trace.state) if ladder_state_name(int(code)) in {"engaged", "stale"}]
    coupled_s = trace.time_s[np.isin(trace.state, codes)]
    return float(trace.time_s[-1] - coupled_s[-1]) if len(coupled_s) else float("inf")


def _protection(scene: "Scene") -> tuple[str, float | None]:
    """Return the names of the controllers of a scene, and the time at which its hand lets go."""
    operator = scene.operator
    released = operator.release.at_s if operator is not None and operator.release is not None else None
    return ", ".join(scene.safety.controllers) or "none", released if scene.master.driver is None else None


# ----------------------------------------------------------------------------------------- the table of this and `demo`


def print_push(console: "Screen", results: "Sequence[PushResult]", *, joints: bool = False) -> None:
    """Print one column a run, and below the table the texts of faults, which fit no column.

    Args:
        console: Output.
        results: Results of the runs.
        joints: True for runs of joints: speeds in rad/s, torques in N m.
    """
    from haptether.cli.shared.table import Column, Rows

    table = Rows("controller", *(Column(result.controller, numbers=True) for result in results))
    for name, show in ROWS.items():
        table.add(_of_joints(name) if joints else name, *(show(result) for result in results))
    if any(result.renewal is not None for result in results):
        # A simulated device has no renewal.
        table.add("ticks with a new sample [%]", *(_figure(result.renewal, 0, 1e2) for result in results))
    console.print(table)
    for result in results:
        if result.fault is not None:
            console.print(f"fault, {result.controller}: {result.fault}", soft_wrap=True)


def _of_joints(label: str) -> str:
    """Return a label with the units of joints."""
    for linear, turning in (
        ("[m/s]", "[rad/s]"),
        ("[N]", "[N m]"),
        ("force on", "torque on"),
        (" away from the wall", ""),
    ):
        label = label.replace(linear, turning)
    return label


def _figure(value: float | None, digits: int, scale: float = 1.0) -> str:
    return "-" if value is None else f"{value * scale:.{digits}f}"


ROWS: "dict[str, Callable[[PushResult], str]]" = {
    "peak hand speed away from the wall [m/s]": lambda of: _figure(of.peak_hand_speed, 3),
    "peak force on the hand [N]": lambda of: _figure(of.peak_force_n, 2),
    "force on the hand when it lets go [N]": lambda of: _figure(of.force_at_release_n, 2),
    "time to trip after the release [ms]": lambda of: _figure(of.time_to_trip_s, 0, 1e3),
    "interventions before the release": lambda of: _figure(of.trips_before_release, 0),
    "time under intervention [s]": lambda of: _figure(of.intervention_s, 2),
    "packets sent": lambda of: str(of.sent),
    "packets lost on the way here": lambda of: str(of.lost),
    "session": lambda of: "secure" if of.security == "secure" else "INSECURE",
    "packets refused": lambda of: str(of.refused),
    "packets overtaken, not used": lambda of: str(of.late),
    "newest round trip [ms]": lambda of: _figure(of.round_trip_s, 1, 1e3),
    "loop wakes late, p50 [ms]": lambda of: f"{of.overshoot_p50_s * 1e3:.3f}",
    "loop wakes late, p99 [ms]": lambda of: f"{of.overshoot_p99_s * 1e3:.3f}",
    "holds (slave silent > 20 ms)": lambda of: str(of.holds),
    "samples replaced (outliers)": lambda of: str(of.outliers),
    "state at the end": lambda of: of.final_state,
}
