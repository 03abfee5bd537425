"""The ladder of safe states on an idle link: both sides coupled while nobody moves."""

from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import LinksTable, Scene, load_scene, simulate
from haptether.netsim import LinkSettings, Once
from haptether.studies.design.contact import scene_numbers

IDLE_S = 60.0
"""Simulated time in s."""
EPISODE_S = 0.45
"""Holds closer than that in s are one: both sides hold in turn, and the simulated hand re-engages 0.5 s after."""
SCRIPT_S = 600.0
"""What a link does at a given time is looked at up to there, in s."""
SETTLED_S = 3.0
"""Within that time in s after what happened once the two are coupled again: reaction, handshake and fade."""
DIRECTIONS = ("forward", "backward")


class IdleLink(Struct, frozen=True, kw_only=True):
    """An idle pair over a link."""

    seconds: float
    engaged: bool
    """Whether the two ever were coupled."""
    coupled: bool
    """Whether they were at the end."""
    holds_s: tuple[float, ...]
    """When the coupling ended, as episodes, in s."""
    stops: int
    """How often a side went to STOP."""
    reason: str
    """Why the coupling first ended or never began; empty where it lasted."""

    @property
    def holds(self) -> int:
        """How often the coupling ended, as episodes."""
        return len(self.holds_s)


def idle_link(scene: Scene, *, seconds: float = IDLE_S) -> IdleLink:
    """Runs link, ladder and periods of a scene with a resting hand, an arm that touches nothing, and no controller.

    Loss, jitter, outages and order of the link count, as the ladder judges them: by silence and by age. What the link
    does once, at a given time, does not: it has no rate.

    Args:
        scene: With an arm and a link.
        seconds: Simulated.
    """
    return _run(scene, _unscripted(scene.link), seconds)


def scripted_link(scene: Scene) -> IdleLink | None:
    """The same of what the link does once: outages, changes of delay and of a clock, over a link that only delays.

    Args:
        scene: With an arm.

    Returns:
        None where nothing happens at a given time within `SCRIPT_S`.
    """
    ends_s = [end_s for _, begin_s, end_s in _happenings(scene.link) if begin_s < SCRIPT_S]
    if not ends_s:
        return None
    return _run(scene, _script_alone(scene), min(max(ends_s), SCRIPT_S) + SETTLED_S)


def script_texts(scene: Scene) -> tuple[str, ...]:
    """What the link does once, each in a few words, as it happens within `SCRIPT_S`."""
    found = sorted(_happenings(scene.link), key=lambda each: each[1])
    return tuple(text for text, begin_s, _ in found if begin_s < SCRIPT_S)


def _happenings(links: LinksTable | None) -> list[tuple[str, float, float]]:
    """What happens once: in words, and when in s it begins and ends."""
    found = []
    for direction in DIRECTIONS:
        settings: LinkSettings | None = getattr(links, direction, None)
        if settings is None:
            continue
        for outage in settings.outages or ():
            if isinstance(times := outage.times, Once):
                text = f"{direction} an outage of {times.duration_s * 1e3:.3g} ms at {times.at_s:g} s"
                found.append((text, times.at_s, times.at_s + times.duration_s))
        for change in settings.timeline or ():
            text = f"{direction} a delay of {change.delay_s * 1e3:.3g} ms from {change.at_s:g} s on"
            found.append((text, change.at_s, change.at_s + change.ramp_s + change.delay_s))
    for side in ("master", "slave"):
        clock = getattr(links, f"{side}_clock", None)
        if clock is not None and clock.step_s > 0.0:
            text = f"the {side}'s clock is set forward by {clock.step_s:g} s at {clock.step_at_s:g} s"
            found.append((text, clock.step_at_s, clock.step_at_s))
    return found


def _unscripted(links: LinksTable | None) -> LinksTable | None:
    """The links without what they do once."""
    if links is None:
        return None
    changed = links
    for direction in DIRECTIONS:
        settings: LinkSettings | None = getattr(links, direction)
        if settings is None:
            continue
        if settings.outages is not None:
            lasting = tuple(outage for outage in settings.outages if not isinstance(outage.times, Once))
            settings = replace(settings, outages=lasting)
        if settings.timeline is not None:
            settings = replace(settings, timeline=())
        changed = replace(changed, **{direction: settings})
    for clock in ("master_clock", "slave_clock"):
        if (table := getattr(links, clock)) is not None:
            changed = replace(changed, **{clock: replace(table, step_s=0.0, step_at_s=0.0)})
    return changed


def _script_alone(scene: Scene) -> LinksTable:
    """Of the links their delay and what they do once."""
    changed = LinksTable() if scene.link is None else scene.link
    delays = scene_numbers(scene)["link"] or {}
    for direction in DIRECTIONS:
        settings: LinkSettings | None = getattr(changed, direction)
        if settings is None:
            continue
        once = tuple(outage for outage in settings.outages or () if isinstance(outage.times, Once))
        alone = LinkSettings(delay_s=delays[direction].get("delay_s"), outages=once, timeline=settings.timeline)
        changed = replace(changed, **{direction: alone})
    return changed


def _run(scene: Scene, link: LinksTable | None, seconds: float) -> IdleLink:
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
        link=link,
        safety=replace(resting.safety, ladder=scene.safety.ladder),
        record=None,
    )
    events = simulate(pair).events
    uncoupled = [event for event in events if event.kind in {"hold", "stop", "never-engaged"}]
    engaged = [event.time_s for event in events if event.kind == "engaged"]
    holds_s = [one.time_s for one in uncoupled if one.kind == "hold"]
    return IdleLink(
        seconds=seconds,
        engaged=bool(engaged),
        coupled=bool(engaged) and all(one.time_s <= engaged[-1] for one in uncoupled),
        holds_s=tuple(
            at_s for place, at_s in enumerate(holds_s) if place == 0 or at_s - holds_s[place - 1] > EPISODE_S
        ),
        stops=sum(1 for one in uncoupled if one.kind == "stop"),
        reason=uncoupled[0].detail if uncoupled else "",
    )
