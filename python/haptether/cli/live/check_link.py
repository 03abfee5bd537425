"""`haptether check-link`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from haptether.bridge import Scene
    from haptether.studies import ContactLoop, Follower, LinkSummary, LinkVerdict

MAX_STIFFNESS = 1e7
MAX_DURATION_S = 600.0
"""A live run keeps the records of ten minutes."""


@dataclass(frozen=True, kw_only=True)
class CheckLink:
    """Measure the link to a running slave, and say whether the coupling can bear it.

    Nothing moves: it is a master whose clutch nobody presses. It takes the slave's one place for a master, and gives it
    back within 0.2 s. Fails if the link is not good enough.

    What is bearable follows from what is touched: the least sum of both delays at which device, hand, arm and wall
    begin to oscillate, and the longest silence at which the ladder does not hold. Device, hand, arm, wall, coupling and
    ladder are those of `--scene`, without it those of `master` and `slave` without a scene.

    Examples:

    haptether check-link --peer 127.0.0.1:9000 --key arm.key

    haptether check-link --peer 192.0.2.7:9000 --key arm.key --duration-s 60 --wall-stiffness 500 --force-scale 0.5

    haptether check-link --peer 127.0.0.1:9000 --key arm.key --scene ur_peg --set coupling.force_scale=0.3
    """

    peer: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the slave, or netsim before it, listens."""
    key: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Key file of the secure session, the same at both sides."""
    insecure: bool = False
    """Go without a key, to a slave that goes without."""
    duration_s: float = 5.0
    """For how long in s, at most 600."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Judge the coupling of a scene, a shipped one or a TOML file; it has a [slave], and as many axes as the slave."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="TABLE.KEY=VALUE")] = ()
    """Change a field of the scene; may be given often."""
    wall_stiffness: float | None = None
    """Stiffness of what will be touched, in N/m; by default 100, or with a scene what is stiffest in it."""
    force_scale: float = 1.0
    """Rendered force over the force that the slave measures; a scene has its own."""
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
        import secrets

        import numpy as np

        from haptether.bridge import LiveMaster, override_scene, scene_json
        from haptether.cli.live.options import handed_over, marked, session_key
        from haptether.cli.live.run import print_security
        from haptether.cli.live.sides import baseline_scene, live_scene
        from haptether.cli.shared.output import check_target
        from haptether.cli.shared.stop import Stopped, wait
        from haptether.studies import judge_link, largest_delay_s, summarise_link

        check_target(self.json)
        key = session_key(self.key, insecure=self.insecure)
        if self.wall_stiffness is not None and not 0.0 < self.wall_stiffness <= MAX_STIFFNESS:
            message = f"wall-stiffness = {self.wall_stiffness:g}: must be above 0, at most {MAX_STIFFNESS:g} N/m"
            raise ValueError(message)
        if not 0.1 <= self.duration_s <= MAX_DURATION_S:
            message = f"duration-s = {self.duration_s:g}: must be between 0.1 and {MAX_DURATION_S:g} s"
            raise ValueError(message)
        scene = live_scene(self, ("force_scale",)) or baseline_scene(force_scale=self.force_scale)
        loops, (period_s, hold_s) = scene_loops(scene, self.wall_stiffness), scene_times(scene)
        worst = min(loops, key=largest_delay_s)
        bearable_s = largest_delay_s(worst)
        with Stopped() as stopped:
            master = stopped.attached(
                LiveMaster(
                    # Nobody presses its clutch, and its device is a model: nothing is driven.
                    scene_json(override_scene(scene, ["operator.clutch=[]"])),
                    peer=self.peer,
                    run_id=secrets.randbits(64),
                    key=key,
                    insecure=self.insecure,
                    # Never engages, so this is when it ends.
                    patience_s=self.duration_s,
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
            # Of a part of what was requested there is no verdict.
            raise KeyboardInterrupt
        if not np.isfinite(trace.age_s).any():
            message = (
                f"no slave answered at {self.peer} within {self.duration_s:g} s: is it running there, free, and with"
                " the same key?"
            )
            raise RuntimeError(message)
        summary = summarise_link(trace, report, scene.run.period_s)
        verdict = judge_link(summary, bearable_s, hold_s + period_s, period_s)
        self._report(summary, verdict, worst)
        return 0 if verdict.good else 1

    def _report(self, summary: "LinkSummary", verdict: "LinkVerdict", loop: "ContactLoop") -> None:
        from haptether.cli.shared.link_table import link_table
        from haptether.cli.shared.output import write_report
        from haptether.cli.shared.screen import screen

        console = screen(self.json)
        console.print(link_table(summary))
        of_scene = "" if self.scene is None else f"{self.scene}: "
        scene = (
            f"{of_scene}position-force coupling, lambda_f = {loop.force_scale:g}, {loop.environment_stiffness:g} N/m, "
            f"{'a hand that holds' if loop.hand_stiffness > 0.0 else 'nobody holds'}"
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
            console.print_item(line)
        write_report(self.json, {"peer": self.peer, "verdict": verdict, "link": summary})


def scene_loops(scene: "Scene", wall_stiffness: float | None = None) -> list["ContactLoop"]:
    """The contact of a scene's device, hand and arm with what is stiffest in it, one loop for each axis that is felt.

    A law that is not linear counts with its slope where it pushes with the largest force that is rendered.

    Args:
        scene: One with a [slave].
        wall_stiffness: In N/m, of what is touched instead; where the scene touches nothing, nothing oscillates.
    """
    from haptether.studies import ContactLoop

    spec = _numbers(scene)
    master, operator, coupling = spec["master"], spec["operator"], spec["coupling"]
    states = [coupling, *coupling["changes"]]
    force_scale, position_scale = (
        max(state[key] for state in states if state[key] is not None) for key in ("force_scale", "position_scale")
    )
    limiter = spec["safety"]["limiter"]
    max_force_n = DEFAULT_FORCE_N if limiter is None else limiter["max_force_n"]
    stiffness, damping = (
        _contact(spec["environment"], max_force_n / force_scale) if wall_stiffness is None else (wall_stiffness, 0.0)
    )
    # What is locked from the first to the last change is never felt.
    locked = set.intersection(*(set(state["locked_axes"]) for state in states if state["locked_axes"] is not None))
    rotated = any(state["quat_wxyz"] not in (None, [1.0, 0.0, 0.0, 0.0]) for state in states)
    return [
        ContactLoop(
            mass_kg=mass_kg,
            damping=viscous + (operator["damping"] if operator else 0.0),
            hand_stiffness=operator["stiffness"] if operator else 0.0,
            environment_stiffness=stiffness,
            environment_damping=damping,
            force_scale=force_scale,
            position_scale=position_scale,
            follower=_arm(spec["slave"]),
        )
        for axis, (mass_kg, viscous) in enumerate(zip(master["mass_kg"], master["viscous"], strict=True))
        if rotated or axis not in locked or len(locked) == master["axes"]
    ]


DEFAULT_FORCE_N = 7.9
"""Where a scene bounds no force: what a PHANTOM Desktop exerts."""


def _numbers(scene: "Scene") -> dict[str, Any]:
    """All numbers of a scene, with presets and defaults filled in."""
    import msgspec

    from haptether.bridge import scene_json

    spec: dict[str, Any] = msgspec.json.decode(scene_json(scene))
    return spec


def _arm(slave: dict[str, Any]) -> "Follower":
    """K_s and B_s that a control amounts to, as `slave/src/arm/model.rs` has them."""
    import math

    from haptether.studies import Follower

    mass_kg, pole = slave["mass_kg"], 2.0 * math.pi * slave["bandwidth_hz"]
    stiffness, damping = {
        "position": (mass_kg * pole**2, 2.0 * mass_kg * pole),
        "velocity": (0.25 * mass_kg * pole**2, mass_kg * pole),
        "pd": (slave["stiffness"], slave["damping"]),
    }[slave["control"]]
    return Follower(
        mass_kg=mass_kg, damping=damping, stiffness=stiffness, follows_velocity=slave["control"] != "position"
    )


def _contact(environment: dict[str, Any] | None, force_n: float) -> tuple[float, float]:
    """K in N/m and B in N s/m of what is stiffest, and of the springs that act all the time."""
    springs, stiffest = [(0.0, 0.0)], (0.0, 0.0)
    for part in environment["objects"] if environment else []:
        contact = part["contact"]
        stiffness, damping, exponent = contact["stiffness"], contact["damping"], contact["exponent"]
        if part["shape"]["kind"] == "spring":
            springs.append((stiffness, damping))
            continue
        if contact["law"] == "hunt-crossley" and stiffness > 0.0:
            # F = K d^n: n F / d, and its damping chi F.
            stiffness = exponent * force_n / (force_n / stiffness) ** (1.0 / exponent)
            damping *= force_n
        stiffest = max(stiffest, (stiffness, damping))
    return sum(k for k, _ in springs) + stiffest[0], sum(b for _, b in springs) + stiffest[1]


def scene_times(scene: "Scene") -> tuple[float, float]:
    """The longer of the two sides' periods, and the silence in s after which the ladder holds."""
    spec = _numbers(scene)
    return max(spec["run"]["period_s"], spec["slave"]["period_s"]), spec["safety"]["ladder"]["hold_after_s"]
