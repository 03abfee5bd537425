"""`haptether check-link`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from haptether.studies import ContactLoop, LinkSummary, LinkVerdict

MAX_STIFFNESS = 1e7
MAX_DURATION_S = 600.0
"""Records of the whole duration are kept in memory."""


@dataclass(frozen=True, kw_only=True)
class CheckLink(FileOptions):
    """Measure the link to a running slave, and say whether the coupling can bear it.

    Nothing moves: it is a master whose clutch nobody presses. The slave has one place for a master; this command takes
    it and gives it back within 0.2 s. Fails if the link is not good enough.

    The limits follow from the touched object. The first is the least sum of both delays at which device, hand, arm and
    wall begin to oscillate, with the intervals beyond it in which they do not. The second is the longest silence at
    which the ladder does not hold. Device, hand, arm, wall, coupling and ladder are those of `--scene`. Without it they
    are those of `master` and `slave` without a scene.

    Examples:

    haptether check-link --peer 127.0.0.1:9000 --key arm.key

    haptether check-link --peer 192.0.2.7:9000 --key arm.key --duration-s 60 --wall-stiffness 500 --force-scale 0.5

    haptether check-link --peer 127.0.0.1:9000 --key arm.key --scene ur_peg --set coupling.force_scale=0.3
    """

    peer: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Address of the slave, or of netsim before it."""
    key: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Key file of the secure session, the same at both sides."""
    insecure: bool = False
    """Go without a key, to a slave without a key."""
    duration_s: float = 5.0
    """Duration in s, at most 600."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Judge the coupling of a scene, a shipped one or a TOML file; it must have a [slave], and as many axes as the
    slave."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a field of the scene; may be given often."""
    wall_stiffness: float | None = None
    """Stiffness of the touched object in N/m; by default 100, or with a scene the stiffest in it."""
    force_scale: float = 1.0
    """Rendered force over the force that the slave measures; a scene has its own."""
    realtime: Literal["auto", "off", "require"] = "auto"
    """Ask for SCHED_FIFO and locked memory and go on without (auto), do not ask (off), or fail without (require)."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the result as JSON at the end; - for standard output."""

    def run(self) -> int:
        """Measure the link and print the findings.

        Raises:
            RuntimeError: No slave answered.
            ValueError: A number out of its bounds.
        """
        import secrets

        import numpy as np

        from haptether.bridge import LiveMaster, override_scene, scene_json
        from haptether.cli.live.options import handed_over, marked, session_key
        from haptether.cli.live.run import print_security
        from haptether.cli.live.sides import baseline_scene, live_scene
        from haptether.cli.shared.output import check_target
        from haptether.cli.shared.stop import Stopped, wait
        from haptether.studies import (
            judge_link,
            largest_delay_s,
            scene_loops,
            scene_times,
            summarise_link,
        )
        from haptether.studies.design.contact import scene_numbers, touched
        from haptether.studies.design.couplings import bearable_delays
        from haptether.studies.design.finding import SHOWN_DELAY_S

        check_target(self.json, force=self.force)
        key = session_key(self.key, insecure=self.insecure)
        if self.wall_stiffness is not None and not 0.0 < self.wall_stiffness <= MAX_STIFFNESS:
            message = f"wall-stiffness = {self.wall_stiffness:g}: must be above 0, at most {MAX_STIFFNESS:g} N/m"
            raise ValueError(message)
        if not 0.1 <= self.duration_s <= MAX_DURATION_S:
            message = f"duration-s = {self.duration_s:g}: must be between 0.1 and {MAX_DURATION_S:g} s"
            raise ValueError(message)
        scene = live_scene(self, ("force_scale",)) or baseline_scene(force_scale=self.force_scale)
        (period_s, hold_s), numbers = scene_times(scene), scene_numbers(scene)
        # A given wall stiffness replaces the scene's objects by one spring.
        beyond = touched(scene, numbers).beyond if self.wall_stiffness is None else ()
        worst = min(scene_loops(scene, self.wall_stiffness), key=largest_delay_s)
        with Stopped() as stopped:
            master = stopped.attached(
                LiveMaster(
                    # Nobody presses its clutch, and its device is a model: nothing is driven.
                    scene_json(override_scene(scene, ["operator.clutch=[]"])),
                    peer=self.peer,
                    run_id=secrets.randbits(64),
                    key=key,
                    insecure=self.insecure,
                    # The run never engages, so it ends after this time.
                    patience_s=self.duration_s,
                    keep_s=self.duration_s + 1.0,
                    realtime=self.realtime,
                )
            )
            handed_over(key)

            def status() -> str:
                master.poll()
                print_security(master.security_events())
                return f"measuring, {master.ticks} ticks"

            headline = marked(f"check-link on {master.address} talks to {self.peer}", insecure=self.insecure)
            headline += f"\nreal time: {master.realtime}"
            wait(headline, status, lambda: master.finished, stopped, None)
            trace, report = master.finish()
            print_security(master.security_events())
        if stopped:
            # A measurement that was cut short gives no verdict.
            raise KeyboardInterrupt
        if not np.isfinite(trace.age_s).any():
            message = (
                f"no slave answered at {self.peer} within {self.duration_s:g} s: is it running there, free, and with"
                " the same key?"
            )
            raise RuntimeError(message)
        summary = summarise_link(trace, report, scene.run.period_s)
        up_to_s = max(SHOWN_DELAY_S, 2.0 * (summary.round_trip_p99_s or 0.0))
        bearable_s, stable_s = bearable_delays(scene, up_to_s, self.wall_stiffness)
        verdict = judge_link(summary, bearable_s, hold_s + period_s, period_s, stable_delays_s=stable_s)
        self._report(summary, verdict, (numbers["coupling"]["kind"], worst), beyond)
        return 0 if verdict.good else 1

    def _report(
        self,
        summary: "LinkSummary",
        verdict: "LinkVerdict",
        coupled: "tuple[str, ContactLoop]",
        beyond: tuple[str, ...],
    ) -> None:
        from haptether.cli.shared.link_table import link_table
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.screen import screen
        from haptether.studies.link_summary import bearable_text

        console = screen(self.json)
        console.print(link_table(summary))
        kind, loop = coupled
        of_scene = "" if self.scene is None else f"{self.scene}: "
        scene = (
            f"{of_scene}{kind} coupling, a device of {loop.mass_kg:g} kg, lambda_f = {loop.force_scale:g}, "
            f"{loop.environment_stiffness:g} N/m, "
            f"{'a hand that holds' if loop.hand_stiffness > 0.0 else 'nobody holds'}"
        )
        bearable = bearable_text(verdict.bearable_delay_s, verdict.stable_delays_s)
        has = "-" if verdict.delay_s is None else f"{verdict.delay_s * 1e3:.1f} ms"
        gap = "-" if verdict.gap_s is None else f"{verdict.gap_s * 1e3:.1f} ms"
        lines = [
            f"{scene}:",
            f"  delay there and back: bears {bearable}, has {has}",
            f"  silence: bears {verdict.bearable_gap_s * 1e3:.1f} ms, had {gap}",
            "a hand that lets go damps nothing: that is what the safety controllers are for",
            *(f"NOT GOOD ENOUGH: {complaint}" for complaint in verdict.complaints),
            *(f"not judged, for it is not in that loop: {one}" for one in beyond),
        ]
        if verdict.good and verdict.is_between:
            lines.append("little room: that delay lies between others at which contact oscillates")
        if verdict.good:
            lines.append("good enough" if not beyond else "good enough for that loop")
        for line in lines:
            console.print_item(line)
        write_report(self.json, {"peer": self.peer, "verdict": verdict, "link": summary, "not_judged": beyond})
