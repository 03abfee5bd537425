"""`haptether master`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from haptether.cli.live.options import LiveOptions
from haptether.cli.shared.options import Controller

if TYPE_CHECKING:
    from haptether.bridge import LiveMaster, MasterRun, MasterTrace, Scene
    from haptether.cli.live.run import Cause, Stopped
    from haptether.studies import LinkSummary, PushResult


ALONE_S = 0.2
"""A slave that ends no longer before the master than this has ended with it."""


@dataclass(frozen=True, kw_only=True)
class Master(LiveOptions):
    """Run the side of the hand: a simulated haptic device held by a simulated hand that can let go.

    Times count from the moment the two sides engage. Starting this command presses the clutch. No press waits for more
    than 5 s: a slave that answers later needs another. When the slave falls silent for 20 ms, the force on the hand
    fades to zero within 75 ms and stays away until the clutch is released and pressed again: `kill -USR1` does that,
    and so does --clutch auto. After a fault `kill -USR2` says first that it is mended. Figures and trace hold the last
    --keep-s.

    Exit status 1 says that no slave answered, that the run ended in fault or, without Ctrl-C, in hold, in stop or after
    the slave, or that a driver failed. Where the two sides are not coupled, the screen says where that happened, in the
    driver's own words, and what to do in order.

    Examples:

    haptether master --peer 127.0.0.1:9000 --key arm.key --controller wsc

    haptether master --peer 127.0.0.1:9001 --key arm.key --release-at-s 2.6 --duration-s 3.4 --json run.json

    haptether master --peer 127.0.0.1:9000 --key arm.key --scene three_axis_box --set safety.controllers=[hsc]
    """

    peer: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the slave, or netsim before it, listens."""
    controller: Controller = "wsc"
    """Safety controller: velocity and force (vfc), windowed energy (wsc), grasp (hsc), or none."""
    listen: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Own address, of the peer's kind (IPv4 or IPv6); any free port by default."""
    key: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Key file of the secure session, the same at both sides; `haptether keygen` makes one."""
    insecure: bool = False
    """Go without a key: frames travel in the clear, and anybody who can send can steer."""
    depth: float = 0.045
    """How deep in m into the wall the hand's target lies."""
    release_at_s: float | None = None
    """When the hand lets go, in s; never if not given."""
    force_scale: float = 1.0
    """Rendered force over the force that the slave measures."""
    encoder_quantum: float = 2.3e-5
    """Resolution of the device in m; 0 measures position and velocity exactly."""
    clutch: Literal["once", "auto"] = "once"
    """Pressed at the start and held; or worked by a simulated person, who presses again 0.5 s after a hold. A scene's
    "auto" counts only where it stands here as well, for a device with a driver, too: else only its button or SIGUSR1
    presses that."""
    flight: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the last states and commands at a stop, at a fault and at the end; `haptether explain` prints them."""
    duration_s: float | None = None
    """End this long after engaging, in s; without it, run until Ctrl-C."""
    patience_s: float = 10.0
    """Give up if the slave has not answered after this time in s."""
    keep_s: float = 600.0
    """How much of the end of the run the figures and the trace hold, in s; its memory is taken at the start."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the result as JSON at the end; - for standard output."""
    trace: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write every tick as NumPy arrays (.npz)."""

    def run(self) -> int:
        """Runs until told to stop; fails if the slave never answered."""
        import numpy as np

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
        from haptether.cli.live.sides import fault_text, live_scene, raise_error, with_clutch
        from haptether.cli.shared.options import check_duration, new_session
        from haptether.cli.shared.output import check_distinct, check_target
        from haptether.studies import measure_push, save_master_trace, summarise_link

        check_duration("duration_s", self.duration_s)
        check_target(self.json)
        check_target(self.trace)
        check_target(self.flight)
        check_distinct(key=self.key, json=self.json, trace=self.trace, flight=self.flight, record=self.record)
        key = session_key(self.key, insecure=self.insecure)
        flight = FlightFile(self.flight)
        live = self.live()
        scene = live_scene(
            self, self.scene, self.set,
            ("controller", "depth", "release_at_s", "force_scale", "encoder_quantum"),
        )  # fmt: skip
        if scene is not None:
            scene = with_clutch(scene, self.clutch)
        how: dict[str, Any] = {
            "peer": self.peer,
            "listen": self.listen,
            "session": new_session(),
            "key": key,
            "insecure": self.insecure,
            "duration_s": self.duration_s,
            "patience_s": self.patience_s,
            "keep_s": self.keep_s,
            **live,
        }
        controller, release_at_s = _protection(scene) if scene is not None else (self.controller, self.release_at_s)
        with Stopped() as stopped:
            master = self._start(scene, stopped, how)
            handed_over(key)
            steps = Steps("master")
            refused: str | None = None

            def status() -> str:
                nonlocal refused
                master.poll()
                acknowledge(master, stopped)
                refused = refused or tell(master.security_events())
                steps.show(master)
                flight.write(master.flight())
                said = fault_text(master) + recording_status(master.recording)
                answer = "" if master.is_answered else ", no answer yet"
                shown = f"master {master.state}{answer}, {master.ticks} ticks{said}"
                return marked(shown, insecure=self.insecure)

            wait(
                marked(f"master on {master.address} talks to {self.peer}", insecure=self.insecure)
                + f"\nreal time: {master.realtime}",
                status,
                lambda: master.finished,
                stopped,
                None,
            )
            trace, report = master.finish()
            check_memory(report)
            refused = refused or tell(master.security_events())
            flight.write(master.flight())
            cause = steps.cause_at_end(master)
        result = measure_push(controller, trace, report, release_at_s)
        self._report(result, summarise_link(trace, report), cause, answered=bool(np.isfinite(trace.age_s).any()))
        if self.trace is not None:
            save_master_trace(trace, self.trace)
        raise_error(master)
        alone = result.final_state == "disengaged" and _uncoupled_s(trace) < ALONE_S
        answered = report.link.fresh > 0
        self._judge(result, answered=answered, stopped=bool(stopped) or alone, refused=refused, cause=cause)
        return 0

    def _start(self, scene: "Scene | None", stopped: "Stopped", how: dict[str, Any]) -> "LiveMaster | MasterRun":
        from haptether.bridge import LiveMaster
        from haptether.cli.live.process_start import started_s
        from haptether.cli.live.sides import start_master
        from haptether.cli.shared.options import master_settings

        how["started_s"] = started_s()
        if scene is not None:
            return start_master(scene, stopped, clutch=self.clutch, **how)
        settings = master_settings(
            self.controller,
            depth=self.depth,
            release_at_s=self.release_at_s,
            force_scale=self.force_scale,
            encoder_quantum=self.encoder_quantum,
            clutch=self.clutch,
        )
        return stopped.attached(LiveMaster(settings, **how))

    def _judge(
        self, result: "PushResult", *, answered: bool, stopped: bool, refused: str | None, cause: "Cause | None"
    ) -> None:
        """Raises what a run that did not end well ended by."""
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
            f"the slave at {self.peer} answered, but the clutch was not pressed since: `kill -USR1` of the master"
            " presses it again"
        )

    def _report(self, result: "PushResult", link: "LinkSummary", cause: "Cause | None", *, answered: bool) -> None:
        import msgspec

        from haptether.cli.link_table import link_table
        from haptether.cli.live.push_table import print_push
        from haptether.cli.shared.output import write_json
        from haptether.cli.shared.screen import screen

        console = screen(self.json)
        # A table of what was not measured is no table.
        if result.engaged_s is not None:
            print_push(console, [result])
        if answered:
            console.print(link_table(link))
        if self.json is not None:
            report = {**msgspec.to_builtins(result), "cause": cause, "link": link}
            write_json(self.json, msgspec.json.format(msgspec.json.encode(report), indent=2))


def _uncoupled_s(trace: "MasterTrace") -> float:
    """For how long in s the two sides have not been coupled at the end."""
    import numpy as np

    from haptether.bridge import ladder_state_name

    codes = [code for code in np.unique(trace.state) if ladder_state_name(int(code)) in {"engaged", "stale"}]
    coupled_s = trace.time_s[np.isin(trace.state, codes)]
    return float(trace.time_s[-1] - coupled_s[-1]) if len(coupled_s) else float("inf")


def _protection(scene: "Scene") -> tuple[str, float | None]:
    """The controllers of a scene, and when its hand lets go."""
    operator = scene.operator
    released = operator.release.at_s if operator is not None and operator.release is not None else None
    return ", ".join(scene.safety.controllers) or "none", released if scene.master.driver is None else None
