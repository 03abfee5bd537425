"""`haptether check-link`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from haptether.studies import ContactLoop, Follower, LinkSummary, LinkVerdict

HOLD_S = 0.02
"""Silence beyond the expected age after which the ladder holds."""
PERIOD_S = 1e-3
MOST_STIFFNESS = 1e7
MOST_DURATION_S = 600.0
"""A live run keeps the records of ten minutes."""


@dataclass(frozen=True, kw_only=True)
class CheckLink:
    """Measure the link to a running slave, and say whether the coupling can bear it.

    Nothing moves: it is a master whose clutch nobody presses. It takes the slave's one place for a master, and gives it
    back within 0.2 s. Fails if the link is not good enough.

    What is bearable follows from what is touched: the least sum of both delays at which device, hand, arm and wall
    begin to oscillate, and the longest silence at which the ladder does not hold.

    Examples:

    haptether check-link --peer 127.0.0.1:9000 --key arm.key

    haptether check-link --peer 192.0.2.7:9000 --key arm.key --duration-s 60 --wall-stiffness 500 --force-scale 0.5
    """

    peer: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the slave, or netsim before it, listens."""
    key: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Key file of the secure session, the same at both sides."""
    insecure: bool = False
    """Go without a key, to a slave that goes without."""
    duration_s: float = 5.0
    """For how long in s, at most 600."""
    wall_stiffness: float = 100.0
    """Stiffness of what will be touched, in N/m."""
    force_scale: float = 1.0
    """Rendered force over the force that the slave measures."""
    realtime: Literal["auto", "off", "require"] = "auto"
    """Ask for SCHED_FIFO and locked memory and go on without (auto), do not ask (off), or fail without (require)."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the result as JSON at the end; - for standard output."""

    def run(self) -> int:
        """Measures, and says what was found.

        Raises:
            RuntimeError: No slave answered.
            ValueError: A number out of its bounds.
        """
        import numpy as np

        from haptether.bridge import LiveMaster
        from haptether.cli.live import Stopped, tell, wait
        from haptether.cli.options import master_settings, new_session
        from haptether.cli.output import check_target
        from haptether.cli.security import marked, session_key
        from haptether.studies import judge_link, largest_delay_s, summarise_link

        check_target(self.json)
        key = session_key(self.key, insecure=self.insecure)
        if not 0.0 < self.wall_stiffness <= MOST_STIFFNESS:
            message = f"wall-stiffness = {self.wall_stiffness:g}: must be above 0, at most {MOST_STIFFNESS:g} N/m"
            raise ValueError(message)
        if not 0.1 <= self.duration_s <= MOST_DURATION_S:
            message = f"duration-s = {self.duration_s:g}: must be between 0.1 and {MOST_DURATION_S:g} s"
            raise ValueError(message)
        settings = master_settings("none", depth=0.0, release_at_s=None, force_scale=self.force_scale, clutch="never")
        bearable_s = largest_delay_s(simulated_loop(self.wall_stiffness, self.force_scale))
        with Stopped() as stopped:
            master = LiveMaster(
                settings,
                peer=self.peer,
                session=new_session(),
                key=key,
                insecure=self.insecure,
                # Never engages, so this is when it ends.
                patience_s=self.duration_s,
                realtime=self.realtime,
            )

            def status() -> str:
                master.poll()
                tell(master.security_events())
                return f"measuring, {master.ticks} ticks"

            headline = marked(f"check-link on {master.address} talks to {self.peer}", insecure=self.insecure)
            headline += f"\nreal time: {master.realtime}"
            wait(headline, status, lambda: master.finished, stopped, None)
            trace, report = master.finish()
            tell(master.security_events())
        if stopped:
            # Of a part of what was asked for there is no verdict.
            raise KeyboardInterrupt
        if not np.isfinite(trace.age_s).any():
            message = (
                f"no slave answered at {self.peer} within {self.duration_s:g} s: is it running there, free, and with"
                " the same key?"
            )
            raise RuntimeError(message)
        summary = summarise_link(trace, report, PERIOD_S)
        verdict = judge_link(summary, bearable_s, HOLD_S + PERIOD_S, PERIOD_S)
        self._report(summary, verdict)
        return 0 if verdict.good else 1

    def _report(self, summary: "LinkSummary", verdict: "LinkVerdict") -> None:
        import msgspec
        from rich.console import Console

        from haptether.cli.link_table import link_table
        from haptether.cli.output import table_goes_to_stderr, write_json

        console = Console(stderr=table_goes_to_stderr(self.json))
        console.print(link_table(summary))
        scene = (
            f"position-force coupling, lambda_f = {self.force_scale:g}, {self.wall_stiffness:g} N/m, a hand that holds"
        )
        bearable = "any delay" if verdict.bearable_delay_s is None else f"{verdict.bearable_delay_s * 1e3:.1f} ms"
        has = "-" if verdict.delay_s is None else f"{verdict.delay_s * 1e3:.1f} ms"
        gap = "-" if verdict.gap_s is None else f"{verdict.gap_s * 1e3:.1f} ms"
        lines = [
            f"{scene}:",
            f"  delay there and back: bears {bearable}, has {has}",
            f"  silence: bears {verdict.bearable_gap_s * 1e3:.1f} ms, had {gap}",
            "a hand that lets go damps nothing: that is what the safety controllers are for",
            *(f"NOT GOOD ENOUGH: {complaint}" for complaint in verdict.complaints),
        ]
        if verdict.good:
            lines.append("good enough")
        for line in lines:
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        if self.json is not None:
            report = {"peer": self.peer, "verdict": verdict, "link": summary}
            write_json(self.json, msgspec.json.format(msgspec.json.encode(report), indent=2))


def simulated_arm() -> "Follower":
    """The arm of `haptether slave`."""
    import math

    from haptether.studies import Follower

    mass_kg, pole = 4.0, 2.0 * math.pi * 15.0  # of `Arm()`
    return Follower(mass_kg=mass_kg, damping=2.0 * mass_kg * pole, stiffness=mass_kg * pole**2)


def simulated_loop(wall_stiffness: float, force_scale: float) -> "ContactLoop":
    """The device and hand of `haptether master` that press a wall through the arm of `haptether slave`."""
    from haptether.cli.options import HAND_DAMPING, HAND_STIFFNESS
    from haptether.master import HapticDevice
    from haptether.studies import ContactLoop

    device = HapticDevice.phantom_desktop()
    return ContactLoop(
        mass_kg=device.mass_kg,
        damping=device.viscous + HAND_DAMPING,
        hand_stiffness=HAND_STIFFNESS,
        environment_stiffness=wall_stiffness,
        force_scale=force_scale,
        follower=simulated_arm(),
    )
