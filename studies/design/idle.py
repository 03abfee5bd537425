"""What a link alone does to the ladder: both sides coupled over it while nobody moves."""

from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import Scene, load_scene, simulate

IDLE_S = 60.0
"""How long."""
EPISODE_S = 0.45
"""Both sides hold one after the other, and a simulated person presses again 0.5 s after that."""


class IdleLink(Struct, frozen=True, kw_only=True):
    """An idle pair over a link."""

    seconds: float
    engaged: bool
    """Whether the two ever were coupled."""
    holds: int
    """How often they were coupled no more."""
    stops: int
    """How often a side went to STOP."""
    reason: str
    """Why they first were not."""


def idle_link(scene: Scene, *, seconds: float = IDLE_S) -> IdleLink:
    """Runs link, ladder and periods of a scene with a resting hand, an arm that touches nothing, and no controller.

    So whatever a link is made of counts, and however a ladder judges it: silence, age over what it is used to, order.

    Args:
        scene: With an arm and a link.
        seconds: Simulated.
    """
    still = load_scene("remote_push", ["safety.controllers=[]"])
    assert still.operator is not None
    assert still.slave is not None
    period_s = scene.slave.period_s if scene.slave is not None else None
    pair = replace(
        still,
        run=replace(still.run, duration_s=seconds, period_s=scene.run.period_s, seed=scene.run.seed),
        slave=replace(still.slave, period_s=period_s),
        operator=replace(still.operator, legs=(), release=None),
        environment=None,
        link=scene.link,
        safety=replace(still.safety, ladder=scene.safety.ladder),
        record=None,
    )
    events = simulate(pair).events
    engaged = any(event.kind == "engaged" for event in events)
    parted = [event for event in events if event.kind in {"hold", "stop", "never-engaged"}]
    begins = [one.time_s for one in parted if one.kind == "hold"]
    holds = sum(1 for place, at_s in enumerate(begins) if place == 0 or at_s - begins[place - 1] > EPISODE_S)
    return IdleLink(
        seconds=seconds,
        engaged=engaged,
        holds=holds,
        stops=sum(1 for one in parted if one.kind == "stop"),
        reason=parted[0].detail if parted else "",
    )
