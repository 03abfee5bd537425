"""The ladder of safe states on an idle link: both sides coupled while nobody moves."""

from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import Scene, load_scene, simulate

IDLE_S = 60.0
"""Simulated time in s."""
EPISODE_S = 0.45
"""Holds closer than that in s are one: both sides hold in turn, and the simulated hand re-engages 0.5 s after."""


class IdleLink(Struct, frozen=True, kw_only=True):
    """An idle pair over a link."""

    seconds: float
    engaged: bool
    """Whether the two ever were coupled."""
    holds: int
    """How often the coupling ended, as episodes."""
    stops: int
    """How often a side went to STOP."""
    reason: str
    """Why the coupling first ended or never began; empty where it lasted."""


def idle_link(scene: Scene, *, seconds: float = IDLE_S) -> IdleLink:
    """Runs link, ladder and periods of a scene with a resting hand, an arm that touches nothing, and no controller.

    Loss, jitter, outages and order of the link count, as the ladder judges them: by silence and by age.

    Args:
        scene: With an arm and a link.
        seconds: Simulated.
    """
    resting = load_scene("remote_push", ["safety.controllers=[]"])
    assert resting.operator is not None
    assert resting.slave is not None
    period_s = scene.slave.period_s if scene.slave is not None else None
    pair = replace(
        resting,
        run=replace(resting.run, duration_s=seconds, period_s=scene.run.period_s, seed=scene.run.seed),
        slave=replace(resting.slave, period_s=period_s),
        operator=replace(resting.operator, legs=(), release=None),
        environment=None,
        link=scene.link,
        safety=replace(resting.safety, ladder=scene.safety.ladder),
        record=None,
    )
    events = simulate(pair).events
    engaged = any(event.kind == "engaged" for event in events)
    uncoupled = [event for event in events if event.kind in {"hold", "stop", "never-engaged"}]
    holds_s = [one.time_s for one in uncoupled if one.kind == "hold"]
    holds = sum(1 for place, at_s in enumerate(holds_s) if place == 0 or at_s - holds_s[place - 1] > EPISODE_S)
    return IdleLink(
        seconds=seconds,
        engaged=engaged,
        holds=holds,
        stops=sum(1 for one in uncoupled if one.kind == "stop"),
        reason=uncoupled[0].detail if uncoupled else "",
    )
