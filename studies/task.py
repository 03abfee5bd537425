"""Bundled scene as a task: the same work by many hands, holding or releasing under force, at any round trip."""

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from difflib import get_close_matches
from math import exp, log
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import (
    LegTable,
    LinksTable,
    Metrics,
    OperatorTable,
    RecordTable,
    ReleaseTable,
    ResearchTable,
    RotationSafetyTable,
    Run,
    Scene,
    SeriesTable,
    Sweep,
    TremorTable,
    load_population,
    load_scene,
    override_scene,
    simulate,
)
from haptether.bridge.codes import LADDER_STATES
from haptether.bridge.scene.load import path_of, toml_value
from haptether.netsim import (
    PRESETS,
    DelayTrace,
    LinkSettings,
    asked,
    judge_all,
    realised,
    repeats_every_s,
    with_files,
)
from haptether.netsim.link.settings import Direction
from haptether.safety import CONTROLLERS
from haptether.studies.design.contact import scene_numbers, touched

Array = npt.NDArray[np.float64]

THRESHOLD_TASKS = (
    "free_motion",
    "paper_wall",
    "active_force",
    "moving_wall",
    "sliding_mass",
    "remote_push",
    "three_axis_box",
    "peg_in_hole",
    "pick_and_place",
    "valve",
)
"""Bundled scenes with a working hand."""
ROUND_TRIPS_S = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
"""Round trips in s by default."""
MAX_ROUND_TRIP_S = 10.0
"""Longest that a study runs."""
HANDS = 8
"""Default number of hands per task."""
RELEASES = 4
"""Default number of release times."""
DIRECTIONS: tuple[Direction, Direction] = ("forward", "backward")
MEASURED_S, LONGEST_MEASURED_S = 60.0, 600.0
"""Time in s of packets at 1 kHz for the mean delay of a network."""
WITHIN_S = 0.5
"""Time in s after the release in which the device is observed."""

COUPLED = frozenset({LADDER_STATES.index("engaged"), LADDER_STATES.index("stale")})
"""Ladder codes in which forces are rendered."""
FIXED = (
    "safety.controllers", "safety.rotation.controllers", "safety.gripper.controllers", "link.forward.delay_s",
    "link.backward.delay_s", "environment.delay_ticks", "run.duration_s", "run.seed", "operator.stiffness",
    "operator.damping", "operator.tremor", "operator.grip_strength_n", "operator.release", "operator.rotation.release",
    "operator.finger.release", "record", "security",
)  # fmt: skip
"""Fields that a task sets, whatever the scene contains."""

DECAY_S = 0.05
"""Decay time of a grip in s: that of a hand that loses a stylus (paper section 4.3)."""
STRENGTH_N = 12.0
"""Grip strength in N until then, above all caps."""
JITTER_OF_DELAY = 0.1
"""Relative standard deviation of a delay, for a scene whose link has jitter."""
HELD_SHARE = 0.5
"""Fraction of the largest force of a holding hand above which it releases."""
STROKES = 3
"""Strokes out, in and out of contact: a hand that withdraws before a late force causes false trips."""
STIFFER = 1.25
"""Smallest ratio of hand stiffness to felt stiffness; below 1 the delayed loop rings with any controller."""
DRAWN_PER_HAND = 64
"""Drawn hands of a population per required hand; most may be too soft."""


class HandBounds(Struct, frozen=True, kw_only=True):
    """Bounds of hands: uniform draws; log-uniform for stiffness, damping and pace."""

    stiffness: tuple[float, float] = (200.0, 600.0)
    """K in N/m, at least 1.25 times the felt stiffness."""
    damping: tuple[float, float] = (8.0, 25.0)
    """B in N s/m."""
    pace: tuple[float, float] = (0.75, 1.4)
    """Ratio of stroke duration to the scene's; 1 if a gripper has its own course."""
    withdrawal_s: tuple[float, float] = (0.3, 1.2)
    """Duration in s of a stroke back to the start, and of the next one in."""
    tremor_m: tuple[float, float] = (2e-5, 2e-4)
    """Amplitude of the tremor in m."""
    tremor_hz: tuple[float, float] = (8.0, 12.0)
    """Tremor frequency in Hz (Elble and Koller 1990)."""
    population: str | None = None
    """Name or file of a population that replaces stiffness, damping and tremor as far as given; hands softer than 1.25
    times the felt stiffness are skipped.
    """


class Network(Struct, frozen=True, kw_only=True):
    """Network effects in addition to the mean delay, equal in both directions."""

    name: str
    jitter: float = 0.0
    """Relative standard deviation of a delay, gamma distributed with a correlation time of 0.1 s."""
    loss: float = 0.0
    """Fraction of lost packets."""
    mean_burst: float = 1.0
    """Mean number of consecutive losses."""
    title: str = ""
    """Origin of a network with its own delay."""
    own: tuple[LinkSettings, LinkSettings] | None = None
    """Forward and backward link of a network with its own delay."""
    own_delay_s: tuple[float, float] | None = None
    """Mean delays in s of these two."""

    @property
    def round_trip_s(self) -> float | None:
        """Own round trip in s, rounded to 0.1 ms; None if the network accepts any."""
        return None if self.own_delay_s is None else round(sum(self.own_delay_s), 4)

    def links(self, delay_s: float) -> tuple[LinkSettings, LinkSettings]:
        """Return the forward and backward link; `delay_s` in s applies to each unless the network has its own."""
        return self.own or (self.link(delay_s),) * 2

    def link(self, delay_s: float) -> LinkSettings:
        """Return one direction, with `delay_s` in s, of a network without its own delay."""
        settings = LinkSettings(delay_s=delay_s)
        if self.jitter > 0.0 and delay_s > 0.0:
            settings = replace(settings, jitter_s=self.jitter * delay_s, distribution="gamma")
        if self.loss > 0.0:
            settings = replace(settings, loss=self.loss, mean_burst=self.mean_burst)
        return settings


def network_of(name: str) -> Network:
    """Return a preset of `haptether netsim list`, or a recording of `haptether netsim record` or IRTT, with its delays.

    Args:
        name: Name of the preset, or path of the .csv or .json file.

    Raises:
        ValueError: Neither a preset nor a readable file, or no packet arrives.
    """
    if name in PRESETS:
        title, settings = f"the preset {name}, {PRESETS[name].title}", LinkSettings(preset=name)
        of: tuple[LinkSettings, LinkSettings] = (settings, settings)
    elif Path(name).is_file():
        trace = LinkSettings(trace=DelayTrace(file=name))
        title = f"the recording {name}, from its beginning in each run"
        try:
            of = (with_files(trace, Path(), "forward"), with_files(trace, Path(), "backward"))
        except ValueError as error:
            # The name of the file is the key here.
            raise ValueError(str(error).removeprefix("trace.file: ")) from None
    else:
        near = get_close_matches(name, PRESETS, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        message = f"{name}: no such file, and no preset: {hint}presets are {', '.join(PRESETS)}"
        raise ValueError(message)
    forward_s, backward_s = (_mean_delay_s(link, way) for link, way in zip(of, DIRECTIONS, strict=True))
    if forward_s is None or backward_s is None:
        message = f"{name}: nothing arrives through it"
        raise ValueError(message)
    return Network(name=Path(name).stem, title=title, own=of, own_delay_s=(forward_s, backward_s))


def _mean_delay_s(settings: LinkSettings, direction: Direction) -> float | None:
    """Return the mean delay in s of arriving packets over a minute, or over the link's recording."""
    if (known := asked(settings, direction).mean_s) is not None:
        return known
    lasts_s = repeats_every_s(settings, direction) or MEASURED_S
    sent_ns = np.arange(0.0, min(lasts_s, LONGEST_MEASURED_S), 1e-3) * 1e9
    return realised(judge_all(settings, np.rint(sent_ns).astype(np.int64), direction=direction)).mean_s


class HeldRun(Struct, frozen=True, kw_only=True):
    """Run of one hand that never releases."""

    metrics: Metrics
    engaged_s: float | None
    """First engagement of the master's side in s; 0 without an arm, None if never engaged."""
    coupled_s: float
    """Coupled time in s; without an arm the whole run."""
    holds: int
    """Number of ends of the coupling: HOLD, STOP or a fault."""
    intervention_s: float
    """Time in s under intervention while coupled."""
    pressed_s: Array
    """Times in s since the engagement at which the hand feels more than half of its largest force."""


class Releases(Struct, frozen=True, kw_only=True):
    """Hands that release under a large force."""

    scene: Scene
    """Scene of the first hand."""
    rows: dict[str, Array]
    """Hands as rows of a sweep, with their release times."""


def refuse_fixed(overrides: Iterable[str], fixed: Iterable[str], why: str) -> None:
    """Refuse overrides of fields that are set anyway, by path; a table counts by each of its fields.

    Raises:
        ValueError: An override is refused, with `why`.
        SceneError: An override is not a `table.key=value` of the schema.
    """
    paths = [path_of(name) for name in fixed]
    for override in overrides:
        key, equals, text = override.partition("=")
        path = path_of(key.strip())
        for leaf in _leaf_paths(path, toml_value(text.strip(), path) if equals else None):
            if any(leaf[: len(of)] == of[: len(leaf)] for of in paths):
                message = f"{override}: {'.'.join(map(str, leaf))} {why}"
                raise ValueError(message)


def _leaf_paths(path: tuple[str | int, ...], value: object) -> Iterator[tuple[str | int, ...]]:
    if isinstance(value, dict) and value:
        for key, part in value.items():
            yield from _leaf_paths((*path, str(key).replace("-", "_")), part)
    else:
        yield path


def along_aims(operator: OperatorTable) -> OperatorTable:
    """Return a hand that holds along the targets of its aims while they gripped; the same without aims.

    A path counts from the engagement, aims from the start: the first press of the clutch is the engagement.
    """
    if operator.aims is None:
        return operator
    begun_s = operator.clutch[0][0] if isinstance(operator.clutch, tuple) and operator.clutch else 0.0
    gripped = [row for row in operator.aims.rows if row.strength_n > 0.0 and row.at_s >= begun_s]
    if not gripped:
        return replace(operator, aims=None)
    points = {0.0: operator.start} | {row.at_s + row.over_s - begun_s: row.target for row in gripped}
    times_s = sorted(points)
    path = SeriesTable(time_s=tuple(times_s), values=tuple(points[time_s] for time_s in times_s))
    return replace(operator, aims=None, recorded=path, start=OperatorTable().start, clutch="auto")


class Task:
    """Scene as a task at one round trip.

    Args:
        name: Name of a bundled scene, path of a scene, or a scene.
        round_trip_s: Sum of both link delays, or the force delay without an arm.
        overrides: Fields to change first.
        network: Network; by default that of the scene, with a jitter of a tenth of its delay.
        by_time: True to end interventions by time, so that each is an event, not as in the scene.
    """

    def __init__(
        self,
        name: str | Scene,
        round_trip_s: float,
        overrides: Iterable[str] = (),
        *,
        network: Network | None = None,
        by_time: bool = True,
    ) -> None:
        if isinstance(name, Scene):
            scene, name = override_scene(name, overrides), name.title or "scene"
        else:
            scene = load_scene(name, overrides)
        if scene.operator is None:
            message = f"{name}: nobody holds its device"
            raise ValueError(message)
        self.name, self.round_trip_s, self.base = name, round_trip_s, scene
        self.operator: OperatorTable = scene.operator
        self.network, self.by_time = network, by_time
        self.strokes = 0
        self.undrawn: tuple[str, ...] = ()
        """Unused properties of a population's hands."""
        self.selection: str | None = None
        """Used fraction of a population, if some of its hands are too soft."""
        self.held = self._delayed(self._held())
        self.can_push = scene.slave is not None or scene.environment is not None
        """True if a force can be felt: there is an arm, or an object."""

    def replaced(self) -> tuple[str, ...]:
        """Return the parts of the scene that the task omits."""
        remarks: list[str] = []
        links, ours = self.base.link or LinksTable(), {"delay_s", "jitter_s", "distribution", "jitter_correlation_s"}
        dropped = {
            name: None
            for link in (links.forward, links.backward)
            for name in (() if link is None else link.__struct_fields__)
            if name not in ours and getattr(link, name)
        }
        if self.base.slave is not None and self.network is not None and dropped:
            remarks.append(f"{self.name} is run without what its own link has: {', '.join(dropped)}.")
        if (research := self.base.safety.research) is not None:
            remarks.append(f"{research.controller} watches {self.name} where it is named as a controller.")
        if self.operator.aims is not None:
            remarks.append(f"{self.name} is done by hands that hold, along the aims of its grips.")
        if self.base.security is not None:
            remarks.append(f"{self.name} is run without its security.")
        if self.selection is not None:
            remarks.append(self.selection)
        if self.undrawn:
            remarks.append(f"{self.name} is done by hands without what else they have: {', '.join(self.undrawn)}.")
        return tuple(remarks)

    def _held(self) -> Scene:
        """Return the scene with a hand that never releases, without recordings."""
        legs = self._legs()
        operator = replace(
            along_aims(self.operator), release=None, grip_strength_n=None, tremor=TremorTable(), legs=legs
        )
        if operator.rotation is not None:
            operator = replace(operator, rotation=replace(operator.rotation, release=None))
        if operator.finger is not None:
            operator = replace(operator, finger=replace(operator.finger, release=None))
        safety = self.base.safety
        if self.by_time:
            safety = replace(safety, hold_off_s=0.1, release_ramp_s=0.2, probe_force_n=0.0, release_tries=0)
        run = replace(self.base.run, duration_s=round(self.base.run.duration_s + self.strokes, 3))
        return replace(self.base, operator=operator, safety=safety, run=run, record=None, security=None)

    def _legs(self) -> tuple[LegTable, ...]:
        """Return the path of the scene; a path that only goes in is extended out, in and out."""
        legs = self.operator.legs
        self.strokes = 0
        if not legs or self.operator.trigger or legs[-1].end == self.operator.start:
            return legs
        self.strokes = STROKES
        ends = (self.operator.start, legs[-1].end)
        return legs + tuple(LegTable(duration_s=1.0, end=ends[place % 2]) for place in range(STROKES))

    def _delayed(self, scene: Scene) -> Scene:
        """Return the scene with forces delayed by the round trip."""
        delay_s = 0.5 * self.round_trip_s
        if scene.slave is not None and self.network is not None:
            forward, backward = self.network.links(delay_s)
            return replace(scene, link=replace(scene.link or LinksTable(), forward=forward, backward=backward))
        if scene.slave is not None:

            def direction(link: LinkSettings | None) -> LinkSettings:
                link = link or LinkSettings()
                jitter_s = JITTER_OF_DELAY * delay_s if link.jitter_s else 0.0
                return replace(link, delay_s=delay_s, jitter_s=jitter_s)

            old = scene.link or LinksTable()
            links = replace(old, forward=direction(old.forward), backward=direction(old.backward))
            return replace(scene, link=links)
        if scene.environment is None:
            return scene
        ticks = round(self.round_trip_s / scene.run.period_s)
        return replace(scene, environment=replace(scene.environment, delay_ticks=ticks))

    def with_controllers(self, scene: Scene, controllers: str | None, fixed: dict[str, float | str]) -> Scene:
        """Return a scene with comma-separated controllers of force, torque and trigger, or without.

        A Python controller has the options of the scene.
        """
        given = (controllers or "").split(",")
        built_in = {name for name, _, _ in CONTROLLERS}
        names = ",".join(name for name in given if name in built_in)
        in_python = [name for name in given if name and name not in built_in]
        if len(in_python) > 1:
            message = f"controllers = {controllers}: {' and '.join(in_python)}: at most one in Python"
            raise ValueError(message)
        research = in_python[0] if in_python else None
        options = self.base.safety.research
        if options is None or options.controller != research:
            options = None if research is None else ResearchTable(controller=research)
        safety = replace(scene.safety, research=options)
        # By default torque and trigger use the controllers of the force.
        if safety.rotation is not None:
            safety = replace(safety, rotation=replace(safety.rotation, controllers=None))
        if safety.gripper is not None:
            safety = replace(safety, gripper=replace(safety.gripper, controllers=None))
        scene = replace(scene, safety=safety)
        changes = [f"safety.{key}={value}" for key, value in fixed.items()]
        return override_scene(scene, [f"safety.controllers=[{names}]", *changes])

    def felt_stiffness(self) -> float:
        """Return the largest felt stiffness in N/m: that of the contact, or of the arm's servo if softer."""
        felt = touched(self.base, scene_numbers(self.base)).stiffness
        if (slave := self.base.slave) is None:
            return felt
        if slave.stiffness is not None:
            felt = min(felt, slave.stiffness) if felt else slave.stiffness
        coupling = self.base.coupling
        return felt if coupling is None else felt * coupling.force_scale * coupling.position_scale

    def hands(self, count: int, seed: int, bounds: HandBounds) -> dict[str, Array]:
        """Return the hands as rows of a sweep; they depend on the seed only, not on the round trip."""
        rng = np.random.default_rng([seed, *Path(self.name).stem.encode()])
        softest = max(bounds.stiffness[0], STIFFER * self.felt_stiffness())
        pace = _log_uniform(rng, bounds.pace, count)
        rows = {
            "operator.stiffness": _log_uniform(rng, (softest, max(softest, bounds.stiffness[1])), count),
            "operator.damping": _log_uniform(rng, bounds.damping, count),
            "operator.tremor.amplitude": rng.uniform(*bounds.tremor_m, count),
            "operator.tremor.frequency_hz": rng.uniform(*bounds.tremor_hz, count),
            "run.seed": rng.integers(1, 2**31, count).astype(np.float64),
        }
        if not self.operator.trigger:
            for place, leg in enumerate(self.operator.legs):
                rows[f"operator.legs.{place}.duration_s"] = leg.duration_s * pace
        withdrawal_s = _log_uniform(rng, bounds.withdrawal_s, count)
        for stroke in range(self.strokes):
            rows[f"operator.legs.{len(self.operator.legs) + stroke}.duration_s"] = withdrawal_s
        if bounds.population is not None:
            people = self._people(bounds.population, count, seed)
            rows |= {path: column for path, column in people.items() if path in rows}
            self.undrawn = tuple(path for path in people if path not in rows)
        return rows

    def _people(self, population: str, count: int, seed: int) -> dict[str, Array]:
        """Return the first hands of a population that are stiff enough by `STIFFER`.

        Raises:
            SceneError: The population does not exist.
            ValueError: Too few of the `DRAWN_PER_HAND` times as many drawn hands are stiff enough.
        """
        drawn = load_population(population).draws(DRAWN_PER_HAND * count, seed)
        softest = STIFFER * self.felt_stiffness()
        stiff = drawn["operator.stiffness"] >= softest
        if stiff.sum() < count:
            message = (
                f"{self.name}: of {DRAWN_PER_HAND * count} hands of {population} {stiff.sum()} have the {softest:g} N/m"
                f" below which the task rings with a delay: {count} are asked for"
            )
            raise ValueError(message)
        if not stiff.all():
            self.selection = f"{self.name} is done by the stiffest {100.0 * stiff.mean():.0f} % of {population}."
        return {path: column[stiff][:count] for path, column in drawn.items()}

    def lasting(self, bounds: HandBounds) -> Scene:
        """Return the held task with the duration that its slowest hand needs."""
        slowest = 1.0 if self.operator.trigger or not self.operator.legs else bounds.pace[1]
        longest_s = self.base.run.duration_s * slowest + self.strokes * bounds.withdrawal_s[1]
        duration_s = round(longest_s + 2.0 * self.round_trip_s, 3)
        return replace(self.held, run=replace(self.held.run, duration_s=duration_s))

    def alone(self, scene: Scene, hands: dict[str, Array], hand: int) -> Scene:
        """Return one hand of a sweep as a separate scene."""
        values = {path: float(column[hand]) for path, column in hands.items()}
        fields = [f"{path}={int(value) if path == 'run.seed' else repr(value)}" for path, value in values.items()]
        return override_scene(scene, fields)

    def hold(self, scene: Scene, hands: dict[str, Array], threads: int | None) -> tuple[HeldRun, ...]:
        """Run each hand in a scene without release."""
        recorded = replace(scene, record=RecordTable())
        lever_m = (scene.safety.rotation or RotationSafetyTable()).lever_m

        def one(hand: int) -> HeldRun:
            return held_run(simulate(self.alone(recorded, hands, hand)), scene.run.period_s, lever_m)

        with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
            return tuple(pool.map(one, range(len(hands["run.seed"]))))

    def releases(
        self, hands: dict[str, Array], held: Iterable[HeldRun], places: int, after_s: float = WITHIN_S
    ) -> Releases | None:
        """Return releasing hands, each while it feels more than half of its largest force without controllers.

        Args:
            hands: Hands as rows of a sweep.
            held: Run of each hand that holds, without controllers.
            places: Number of release times within that time; the hands share them.
            after_s: Time in s that the run continues after the release.

        Returns:
            None without felt forces.
        """
        count = len(hands["run.seed"])
        places = min(places, count)
        chosen, at_s, lasts_s = [], [], []
        for hand, run in enumerate(held):
            if run.engaged_s is None or not run.pressed_s.size:
                continue
            share = (hand % places + 0.5) / places
            chosen.append(hand)
            at_s.append(round(float(run.pressed_s[int(share * run.pressed_s.size)]), 3))
            lasts_s.append(round(run.engaged_s + at_s[-1] + DECAY_S + after_s, 3))
        if not chosen:
            return None
        rows = {path: values[chosen] for path, values in hands.items()}
        rows["operator.release.at_s"] = np.array(at_s)
        operator = self.held.operator or self.operator
        # The release of a rotating hand also applies to its rotation.
        release = ReleaseTable(at_s=at_s[0], decay_s=DECAY_S)
        operator = replace(operator, release=release, grip_strength_n=STRENGTH_N)
        if operator.rotation is not None:
            operator = replace(operator, rotation=replace(operator.rotation, release=replace(release, kind="gain")))
            rows["operator.rotation.release.at_s"] = np.array(at_s)
        rows["run.duration_s"] = np.array(lasts_s)
        run_table = replace(self.held.run, duration_s=lasts_s[0])
        return Releases(scene=replace(self.held, operator=operator, run=run_table), rows=rows)


def held_run(run: Run, period_s: float, lever_m: float) -> HeldRun:
    """Return the figures of a run without release.

    The felt force is the larger of |F| and |tau| / r in N, with r the lever of the hand.

    Args:
        run: Run with signals at each tick.
        period_s: Tick period in s.
        lever_m: r in m, distance of the hand from the centre of a handle.
    """
    signals = run.signals
    time_s = np.asarray(signals["time_s"])
    ticks = len(time_s)

    def size(name: str) -> Array:
        sizes: Array = np.linalg.norm(np.asarray(signals[name]).reshape(ticks, -1), axis=1)
        return sizes

    felt = size("device_force")
    tripped = np.asarray(signals["tripped"]) > 0
    if "device_torque" in signals:
        felt = np.maximum(felt, size("device_torque") / lever_m)
        tripped |= np.asarray(signals["rotation_tripped"]) > 0
    coupled, engaged_s = np.ones(ticks, dtype=bool), 0.0 if ticks else None
    if "state" in signals:
        coupled = np.isin(signals["state"], sorted(COUPLED))
        # Release times count from the engagement of the master's side.
        engaged = np.flatnonzero(coupled)
        engaged_s = float(time_s[engaged[0]]) if engaged.size and run.metrics.outcome != "never-engaged" else None
    ended = coupled[:-1] & ~coupled[1:]
    since_s = time_s - (engaged_s or 0.0)
    pressed = coupled & (felt > 0.0) & (felt >= HELD_SHARE * felt.max(initial=0.0)) & (since_s > 0.0)
    return HeldRun(
        metrics=run.metrics,
        engaged_s=engaged_s,
        coupled_s=float(coupled.sum()) * period_s,
        holds=int(ended.sum()),
        intervention_s=float((tripped & coupled).sum()) * period_s,
        pressed_s=since_s[pressed] if engaged_s is not None else np.empty(0),
    )


def ejection_metrics(scene: Scene) -> list[str]:
    """Return the metrics that `ejection_speeds` needs."""
    return ["max_ejection_velocity", *(["max_ejection_rate"] if scene.master.kind == "pose" else [])]


def ejection_speeds(scene: Scene, found: Sweep) -> Array:
    """Return the largest speed in m/s after each release of a sweep: of the device, or of a handle at its lever."""
    speed = np.nan_to_num(np.asarray(found["max_ejection_velocity"], dtype=np.float64))
    if "max_ejection_rate" in found.columns:
        lever_m = (scene.safety.rotation or RotationSafetyTable()).lever_m
        rate = np.nan_to_num(np.asarray(found["max_ejection_rate"], dtype=np.float64))
        speed = np.maximum(speed, rate * lever_m)
    return speed


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float], count: int) -> Array:
    low, high = map(log, bounds)
    drawn: Array = np.array([exp(value) for value in rng.uniform(low, high, count)])
    return drawn
