"""The ladder of safe states on an idle link: both sides coupled while nobody moves."""

from typing import Literal, TypeAlias

from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import LinksTable, Scene, load_scene, simulate
from haptether.netsim import LinkSettings, Once
from haptether.studies.design.contact import scene_numbers

IDLE_S = 60.0
"""Simulated time in s."""
EPISODE_S = 0.45
"""Holds closer than this in s count as one episode: both sides hold in turn, and the hand re-engages 0.5 s later."""
MAX_ONCE_S = 600.0
"""Single events are run only if they begin before this time in s."""
MAX_RUN_S = 1200.0
"""Longest run in s."""
ONCE_SEEDS = 4
"""Number of seeds for runs of single events over the whole link."""
SETTLED_S = 3.0
"""Time in s after a single event by which the sides must be coupled again: reaction, handshake and fade."""
DIRECTIONS = ("forward", "backward")
EventKind: TypeAlias = Literal["outage", "delay", "clock"]


class SingleEvent(Struct, frozen=True, kw_only=True):
    """A single event of a link at a given time."""

    kind: EventKind
    text: str
    """Description in a few words."""
    begin_s: float
    end_s: float
    """Start and end in s since the link began."""


class IdleLink(Struct, frozen=True, kw_only=True):
    """Result of an idle pair of sides on a link."""

    seconds: float
    engaged: bool
    """True if the sides were ever coupled."""
    coupled: bool
    """True if they were coupled at the end."""
    holds_s: tuple[float, ...]
    """Times in s at which the coupling ended, as episodes."""
    stops: int
    """Number of transitions to STOP."""
    reason: str
    """Reason why the coupling first ended or never began; empty if it lasted."""

    @property
    def holds(self) -> int:
        """Number of episodes in which the coupling ended."""
        return len(self.holds_s)


def idle_link(scene: Scene, *, seconds: float = IDLE_S) -> IdleLink:
    """Run link, ladder and periods of a scene with a resting hand, an arm in free space, and no controller.

    Loss, jitter, outages and reordering act through the ladder's limits on silence and age. Single events of the link
    are left out, because they have no rate.

    Args:
        scene: Scene with an arm and a link.
        seconds: Simulated time.
    """
    return _run(scene, _without_single_events(scene.link), seconds)


class OnceOnLink(Struct, frozen=True, kw_only=True):
    """Runs of the whole link with its single events, over several seeds."""

    runs: int
    held: int
    """Runs in which the ladder holds between the start of an event and `SETTLED_S` after its end."""
    holds: int
    """Number of such holds, as episodes."""
    stops: int
    """Number of transitions to STOP in all runs."""
    uncoupled: int


def link_with_single_events(scene: Scene) -> IdleLink | None:
    """Run the single events of the link (outages, changes of delay and of a clock) over a link that only delays.

    Args:
        scene: Scene with an arm.

    Returns:
        None without a single event before `MAX_ONCE_S`.
    """
    if (seconds := _seconds_with(scene)) is None:
        return None
    return _run(scene, _single_events_over_delay(scene), seconds)


def single_events_on_link(scene: Scene) -> tuple[OnceOnLink, OnceOnLink] | None:
    """Run the whole link, with jitter, loss and reordering, with its single events and without.

    Args:
        scene: Scene with an arm.

    Returns:
        None without a single event before `MAX_ONCE_S`.
    """
    if (seconds := _seconds_with(scene)) is None:
        return None
    events, without = _run_events(scene), _without_single_events(scene.link)
    return _runs_with(scene, scene.link, events, seconds), _runs_with(scene, without, events, seconds)


def single_events(scene: Scene) -> tuple[SingleEvent, ...]:
    """Single events of a scene's link in the order of time."""
    links, found = scene.link, list[SingleEvent]()
    for direction in DIRECTIONS:
        settings: LinkSettings | None = getattr(links, direction, None)
        if settings is None:
            continue
        for outage in settings.outages or ():
            if isinstance(times := outage.times, Once):
                text = f"{direction} an outage of {times.duration_s * 1e3:.3g} ms at {times.at_s:g} s"
                end_s = times.at_s + times.duration_s
                found.append(SingleEvent(kind="outage", text=text, begin_s=times.at_s, end_s=end_s))
        for change in settings.timeline or ():
            text = f"{direction} a delay of {change.delay_s * 1e3:.3g} ms from {change.at_s:g} s on"
            end_s = change.at_s + change.ramp_s + change.delay_s
            found.append(SingleEvent(kind="delay", text=text, begin_s=change.at_s, end_s=end_s))
    for side in ("master", "slave"):
        clock = getattr(links, f"{side}_clock", None)
        if clock is not None and clock.step_s > 0.0:
            text = f"the {side}'s clock is set forward by {clock.step_s:g} s at {clock.step_at_s:g} s"
            found.append(SingleEvent(kind="clock", text=text, begin_s=clock.step_at_s, end_s=clock.step_at_s))
    return tuple(sorted(found, key=lambda event: event.begin_s))


def _run_events(scene: Scene) -> tuple[SingleEvent, ...]:
    return tuple(event for event in single_events(scene) if event.begin_s < MAX_ONCE_S)


def _seconds_with(scene: Scene) -> float | None:
    """Length in s of a run with the single events; None without events."""
    ends_s = [event.end_s for event in _run_events(scene)]
    return min(max(ends_s) + SETTLED_S, MAX_RUN_S) if ends_s else None


def _runs_with(scene: Scene, link: LinksTable | None, events: tuple[SingleEvent, ...], seconds: float) -> OnceOnLink:
    """Run a link over `ONCE_SEEDS` seeds, from the scene's on, and count holds during the events."""
    runs = [_run(scene, link, seconds, seed=scene.run.seed + more) for more in range(ONCE_SEEDS)]
    holds = [
        sum(1 for at_s in run.holds_s if any(one.begin_s <= at_s <= one.end_s + SETTLED_S for one in events))
        for run in runs
    ]
    return OnceOnLink(
        runs=len(runs),
        held=sum(1 for count in holds if count),
        holds=sum(holds),
        stops=sum(run.stops for run in runs),
        uncoupled=sum(1 for run in runs if not run.coupled),
    )


def _without_single_events(links: LinksTable | None) -> LinksTable | None:
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


def _single_events_over_delay(scene: Scene) -> LinksTable:
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


def _run(scene: Scene, link: LinksTable | None, seconds: float, *, seed: int | None = None) -> IdleLink:
    resting = load_scene("remote_push", ["safety.controllers=[]"])
    assert resting.operator is not None
    assert resting.slave is not None
    period_s = scene.slave.period_s if scene.slave is not None else None
    pair = replace(
        resting,
        run=replace(
            resting.run,
            duration_s=seconds,
            period_s=scene.run.period_s,
            seed=scene.run.seed if seed is None else seed,
        ),
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
