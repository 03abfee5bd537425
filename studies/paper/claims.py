"""Quantitative claims of the paper's section 4, compared with this project.

Source: "Safety Control for Impedance Haptic Interfaces", sections 4.1 to 4.5.
"""

from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge import LocalTrace, Sinusoid, run_local
from haptether.master import Hand, HapticDevice
from haptether.safety import ControllerName, SafetySettings
from haptether.slave import Wall
from haptether.studies.operator import Operator
from haptether.studies.paper.conditions import DESKTOP_QUANTUM, ESTIMATORS, MET_BY, Conditions, change_text, changed
from haptether.studies.paper.report import Change, PaperReport, PaperRow

Array = npt.NDArray[np.float64]

PERIOD_S = 1e-3
STIFFNESS = 200.0
"""K in N/m of most experiments."""
DEPTH = 0.039
"""D in m of most experiments."""
MAX_FORCE_N = 7.8
"""Pressing force of Fig. 5a in N."""
WINDOWS = (50, 100, 200, 500, 1000, 2000, 4000, 5000, 6000, 10000)
TABLE_1 = (0.438, 0.357, 0.348, 0.35, 0.52, 0.549, 0.739, 0.823, 1.096, 1.094)
ACTIVE_RATE = 5.0
"""Rate in rad/s of the active force sin(5 t)."""
ACTIVE_RELEASE_S = 1.35
ACTIVE_THRESHOLD_J = -0.005
RAISED_FORCE_THRESHOLD_N = 0.3
"""F_t of HSC in N at which a grip has absorbed the active force before it counts, see `GRIP_YIELDS`."""
AFTER_S = 0.5
"""Time in s that a run continues after the release."""
AMPLITUDES_N = (1.0, 2.0, 3.0, 4.0, 5.0)
GRIP_YIELDS = (
    "the grip takes a force up as the stylus yields to it: while sin(5 t) grows, S_h is above zeta up to 0.27 N, and "
    "F_t is 0.1 N; once tripped, nothing loads the hand, and it stays tripped"
)
HELD_S = 0.1
"""Time in s before the release in which a trip may still act on it: 100 ticks, the window of WSO."""
MOVES = 1e-3
"""Speed in m/s above which the stylus moves; below it friction and hand hold it."""


def as_printed(*controllers: ControllerName, **thresholds: Any) -> SafetySettings:  # noqa: ANN401
    """Return the paper's law: a trip cancels the force, which returns as soon as nothing trips."""
    law = {"hold_off_s": 0.0, "release_ramp_s": 0.0, "probe_force_n": 0.0, "release_tries": 0}
    gates = {"hsc_velocity_threshold": 0.0, "wsc_force_threshold_n": 0.0}
    return SafetySettings(controllers, **{**law, **gates, **thresholds})


WATCHED = as_printed(
    "hsc", "wsc", "pc", grasp_threshold=1e6, energy_threshold_j=-1e6, pc_max_damping=0.0
)  # fmt: skip
"""HGO, WSO and SO observe without intervention: unreachable thresholds and zero damping."""


class Bench:
    """Device and operator of the paper, and cached runs for the rows."""

    def __init__(self, conditions: Conditions | None = None) -> None:
        self.conditions = of = conditions or Conditions()
        self.operator = of.operator
        declared = HapticDevice.phantom_desktop()
        self.device = HapticDevice(
            mass_kg=of.mass_kg, viscous=declared.viscous, coulomb=of.coulomb, encoder_quantum=of.encoder_quantum
        )
        self._estimator = ESTIMATORS[of.estimator](of.encoder_quantum or DESKTOP_QUANTUM)
        self._traces: dict[tuple[object, ...], LocalTrace] = {}

    def law(self, *controllers: ControllerName, **thresholds: Any) -> SafetySettings:  # noqa: ANN401
        """Return the law as printed, except for values in the conditions."""
        declared = {"hsc_force_threshold_n": self.conditions.hsc_force_threshold_n}
        return as_printed(*controllers, **declared | thresholds)

    def read_as(self, reading: Change) -> "Bench":
        """Return the same runs with other values of the `READINGS` factors, which affect no run."""
        other = Bench(changed(self.conditions, reading))
        other._traces = self._traces
        return other

    def _run(self, hand: Hand, rendered: Wall | Sinusoid, ticks: int, settings: SafetySettings | None) -> LocalTrace:
        return run_local(
            self.device, hand, rendered, ticks=ticks, settings=settings, estimator=self._estimator,
            device_delay=self.conditions.device_delay,
        )  # fmt: skip

    def press(
        self,
        settings: SafetySettings | None = None,
        *,
        stiffness: float = STIFFNESS,
        depth: float = DEPTH,
    ) -> LocalTrace:
        """Run press, hold and release."""
        key = ("press", stiffness, depth, repr(settings))
        if key not in self._traces:
            hand, wall = self.operator.pressing(stiffness, depth), Wall(stiffness=stiffness)
            ticks = self.release_tick + round(AFTER_S / PERIOD_S)
            self._traces[key] = self._run(hand, wall, ticks, settings)
        return self._traces[key]

    def active(self, amplitude_n: float, settings: SafetySettings | None, release_at_s: float | None) -> LocalTrace:
        """Run a grip against the active force, with or without release."""
        key = ("active", amplitude_n, release_at_s, repr(settings))
        if key not in self._traces:
            hand = self.operator.gripping(amplitude_n, release_at_s)
            force = Sinusoid(amplitude_n=amplitude_n, rate=ACTIVE_RATE)
            self._traces[key] = self._run(hand, force, round(2.0 / PERIOD_S), settings)
        return self._traces[key]

    def free(self) -> LocalTrace:
        """Run the active force without a hand."""
        return self._run(Hand.absent(), Sinusoid(amplitude_n=1.0, rate=ACTIVE_RATE), 400, None)

    @property
    def release_tick(self) -> int:
        """Tick of a press at which the release begins."""
        return round(self.operator.release_at_s / PERIOD_S)

    def after_release(self, signal: npt.NDArray[np.generic]) -> Array:
        """Return a signal of `press` from the release on."""
        return np.asarray(signal[self.release_tick :], dtype=np.float64)

    def since_release(self, condition: npt.NDArray[np.bool_]) -> float | None:
        """Return the time in s from the release, by the clock of the conditions, to the first tick of a condition."""
        time = first_time(self.after_release(condition) > 0.0)
        if time is None:
            return None
        if self.conditions.clock == "end":
            return time - self.operator.release_s
        if self.conditions.clock == "motion":
            return time - (first_time(self.after_release(self.press().velocity) > MOVES) or 0.0)
        return time

    def ejection(self, trace: LocalTrace) -> float:
        """Return MEV in m/s: largest speed away from the wall after the release, within the conditions' time."""
        return float(self.after_release(trace.velocity)[: round(self.conditions.mev_within_s / PERIOD_S)].max())


def first_time(condition: npt.NDArray[np.bool_]) -> float | None:
    """Return the time in s of the first tick at which the condition holds."""
    ticks = np.flatnonzero(condition)
    return float(ticks[0]) * PERIOD_S if ticks.size else None


def met_by(experiment: str) -> str:
    """Return the entry of `MET_BY` for an experiment as text."""
    return f"met by: {change_text(MET_BY[experiment])}"


def held_trip(trace: LocalTrace, release_tick: int) -> str:
    """Return the reason why a run is void if a controller tripped while the hand still held."""
    held = trace.tripped[max(0, release_tick - round(HELD_S / PERIOD_S)) : release_tick]
    return "tripped before the release" if (held > 0).any() else ""


def reproduce_paper(
    operator: Operator | None = None,
    *,
    encoder_quantum: float = 0.0,
    progress: Callable[[int, int], None] | None = None,
) -> PaperReport:
    """Run every experiment.

    Args:
        operator: Pressing and releasing hand; by default the declared one.
        encoder_quantum: Resolution of the device in m; 0 measures position and velocity exactly, otherwise the Kalman
            filter of `ESTIMATORS` is used.
        progress: If given, called after each experiment with the finished and the total number.

    Raises:
        ValueError: A parameter is out of range; gives its bound.
    """
    conditions = Conditions(operator=operator or Operator(), encoder_quantum=encoder_quantum)
    device = Bench(conditions).device
    bench, rows = Bench(conditions), list[PaperRow]()
    for done, experiment in enumerate(EXPERIMENTS, start=1):
        rows += experiment(bench)
        if progress is not None:
            progress(done, len(EXPERIMENTS))
    return PaperReport(
        operator=conditions.operator,
        device={
            "mass_kg": device.mass_kg,
            "viscous": device.viscous,
            "coulomb": device.coulomb,
            "encoder_quantum": device.encoder_quantum,
        },
        rows=rows,
    )


def claims(bench: Bench) -> Iterator[PaperRow]:
    """Yield all rows in fixed order."""
    for experiment in EXPERIMENTS:
        yield from experiment(bench)


def ejection_rows(bench: Bench) -> Iterator[PaperRow]:
    """Yield sections 4.1 and 4.2, Fig. 4 and 5: no intervention."""
    trace = bench.press()
    velocity = bench.after_release(trace.velocity)
    low, high = first_time(velocity >= 0.2), first_time(velocity >= 1.2)
    rise = None if low is None or high is None else high - low
    yield PaperRow(
        source="Fig. 4a",
        quantity="time_from_0.2_to_1.2_m_per_s",
        controller="none",
        stiffness=STIFFNESS,
        depth=DEPTH,
        paper=0.02,
        ours=rise,
        unit="s",
        note="0.02 s takes 50 m/s^2, which is all of 7.8 N on 0.157 kg to the end; a wall unloads on the way",
    )
    yield PaperRow(
        source="Fig. 4b", quantity="time_to_0.1_m_outside", controller="none", stiffness=STIFFNESS, depth=DEPTH,
        paper=0.25,
        ours=bench.since_release(trace.position >= 0.1), unit="s",
        note="0.1 m at 1.3 m/s take 0.08 s; a hand that lets go as slowly as this throws at half the MEV of Fig. 5",
    )  # fmt: skip
    printed = {200.0: 1.4, 1000.0: 0.5}
    for stiffness in np.arange(200.0, 1001.0, 100.0).tolist():
        depth = MAX_FORCE_N / stiffness
        mev = bench.ejection(bench.press(stiffness=stiffness, depth=depth))
        yield PaperRow(
            source="Fig. 5a", quantity="max_ejection_velocity", controller="none", stiffness=stiffness,
            depth=depth, paper=printed.get(stiffness), ours=mev, unit="m/s",
            note="pressed to 7.8 N",
        )  # fmt: skip
    for depth in (0.01, 0.015, 0.02, 0.025, 0.03, 0.035, 0.039):
        mev = bench.ejection(bench.press(depth=depth))
        yield PaperRow(
            source="Fig. 5b", quantity="max_ejection_velocity", controller="none", stiffness=STIFFNESS,
            depth=depth, paper=1.4 if depth == DEPTH else None, ours=mev, unit="m/s",
            note="nearly proportional to the depth",
        )  # fmt: skip


def released_at_rest(stiffness: float, depth: float, settings: SafetySettings | None = None) -> LocalTrace:
    """Run a frictionless device at rest at `depth`, released from the start."""
    device = HapticDevice(mass_kg=HapticDevice.phantom_desktop().mass_kg)
    return run_local(
        device,
        Hand.absent(),
        Wall(stiffness=stiffness),
        ticks=round(AFTER_S / PERIOD_S),
        settings=settings,
        start=(-depth, 0.0),
    )


def closed_form_rows(operator: Operator) -> Iterator[PaperRow]:
    """Yield closed forms: no friction, instantaneous release; "paper" is the value of the equation."""
    mass = HapticDevice.phantom_desktop().mass_kg
    for stiffness, depth in ((200.0, 0.01), (200.0, 0.039), (500.0, 0.0156), (1000.0, 0.0078)):
        trace = released_at_rest(stiffness, depth)
        yield PaperRow(
            source="Eq. 17", quantity="max_ejection_velocity", controller="none", stiffness=stiffness,
            depth=depth, paper=float(np.sqrt(stiffness / mass)) * depth,
            ours=float(trace.velocity.max()), unit="m/s",
            note="no friction, instant release: sqrt(K/m) D; a held wall adds pi/8 dT sqrt(K/m)",
        )  # fmt: skip
    settings = as_printed("wsc")
    trace = released_at_rest(STIFFNESS, DEPTH, settings)
    threshold, ratio = 0.03, 0.5
    yield PaperRow(
        source="Eq. 13", quantity="speed_at_trip", controller="wsc", window=100, stiffness=STIFFNESS,
        depth=DEPTH, paper=float(np.sqrt(2.0 * ratio * threshold / mass)),
        ours=float(trace.velocity[np.flatnonzero(trace.tripped)[0]]), unit="m/s",
        note="no friction, instant release from rest: sqrt(2 eta |delta| / m); first tick beyond it",
    )  # fmt: skip

    # Same, with the whole press inside the window.
    operator = msgspec.structs.replace(operator, release_s=0.0)
    trace = run_local(
        HapticDevice(mass_kg=mass),
        operator.pressing(STIFFNESS, DEPTH),
        Wall(stiffness=STIFFNESS),
        ticks=round((operator.release_at_s + AFTER_S) / PERIOD_S),
        settings=as_printed("wsc", window=10000),
    )
    stored = STIFFNESS * DEPTH**2 / 2.0
    yield PaperRow(
        source="Eq. 13", quantity="speed_at_trip", controller="wsc", window=10000, stiffness=STIFFNESS,
        depth=DEPTH, paper=float(np.sqrt((threshold + stored) * 2.0 * ratio / mass)),
        ours=float(trace.velocity[np.flatnonzero(trace.tripped)[0]]), unit="m/s",
        note="no friction, instant release, whole press inside: sqrt((|delta| + K D^2/2) 2 eta / m)",
    )  # fmt: skip


def observer_rows(bench: Bench) -> Iterator[PaperRow]:
    """Yield section 4.3, Fig. 6: observers without intervention."""
    trace = bench.press(WATCHED)
    yield PaperRow(
        source="Fig. 6a", quantity="time_to_see_release", controller="so", stiffness=STIFFNESS, depth=DEPTH, paper=0.06,
        relation=">", ours=bench.since_release(trace.energy_j < -0.03), unit="s",
        note=f"it trips at mV^2/2 = eta (K D^2/2 + |delta|) = 0.091 J, 60 % of what is stored; {met_by('Fig. 6')}",
    )  # fmt: skip
    yield PaperRow(
        source="Fig. 6a", quantity="time_to_see_release", controller="wso", window=100, stiffness=STIFFNESS,
        depth=DEPTH,
        paper=0.036, ours=bench.since_release(trace.windowed_energy_j < -0.03), unit="s", note=met_by("Fig. 6"),
    )  # fmt: skip
    yield PaperRow(
        source="Fig. 6b", quantity="time_to_see_release", controller="hgo", stiffness=STIFFNESS, depth=DEPTH,
        paper=0.048, ours=bench.since_release(trace.grasp > 1.5), unit="s",
        note=met_by("Fig. 6"),
    )  # fmt: skip


def controller_rows(bench: Bench) -> Iterator[PaperRow]:
    """Yield section 4.4, Fig. 7 to 11: VFC, HSC, WSC."""
    release = bench.release_tick
    normal = bench.press(bench.law("vfc"))
    yield PaperRow(
        source="Fig. 7", quantity="trips_during_press", controller="vfc", stiffness=STIFFNESS, depth=DEPTH, paper=0.0,
        ours=float(np.count_nonzero(normal.tripped[:release])), unit="1", note="V_t = 0.6 m/s",
    )  # fmt: skip
    eager = bench.press(bench.law("vfc", velocity_threshold=0.14))
    yield PaperRow(
        source="Fig. 7", quantity="trips_during_press", controller="vfc", stiffness=STIFFNESS, depth=DEPTH,
        paper=0.0, relation=">", ours=float(np.count_nonzero(eager.tripped[:release])), unit="1",
        note="V_t = 0.14 m/s; who presses has V F < 0, so that Eq. 1 trips at no V_t; |V| alone is above it in the "
        "paper's curve, where the hand picks up at 0.285 m/s",
    )  # fmt: skip
    runs = {
        "vfc": (
            bench.law("vfc"), "Fig. 8", 0.75, 0.073,
            "Eq. 1 as printed, the product, trips at V F = 0.6 W, 0.08 m/s at 7.8 N: the paper had the other reading",
        ),
        "vfc-both": (
            bench.law("vfc", vfc_form="both"), "Fig. 8", 0.75, 0.073,
            "Eq. 1 as the text has it, both thresholds at the same time; " + met_by("Fig. 8 vfc-both"),
        ),
        "hsc": (
            bench.law("hsc"), "Fig. 9", 0.3, 0.072,
            met_by("Fig. 9"),
        ),
        "wsc": (
            bench.law("wsc"), "Fig. 10", 0.357, None,
            "value of Table 1; the largest is a second throw, when the first has left the window; " + met_by("Fig. 10"),
        ),
    }  # fmt: skip
    mev: dict[str, float] = {}
    voids: dict[str, str] = {}
    for name, (settings, source, paper_mev, paper_time, note) in runs.items():
        trace = bench.press(settings)
        mev[name] = bench.ejection(trace)
        void = voids[name] = held_trip(trace, release)
        window = 100 if name == "wsc" else None
        yield PaperRow(
            source=source, quantity="max_ejection_velocity", controller=name, window=window, stiffness=STIFFNESS,
        depth=DEPTH,
            paper=paper_mev, ours=mev[name], unit="m/s", note=note, says_nothing=void,
        )  # fmt: skip
        yield PaperRow(
            source=source, quantity="time_to_trip", controller=name, window=window, stiffness=STIFFNESS, depth=DEPTH,
            paper=paper_time, ours=bench.since_release(trace.tripped > 0), unit="s", note=note, says_nothing=void,
        )  # fmt: skip
        if name.startswith("vfc"):
            tripped = np.flatnonzero(bench.after_release(trace.tripped))
            yield PaperRow(
                source=source, quantity="speed_at_trip", controller=name, stiffness=STIFFNESS, depth=DEPTH,
                paper=0.6, unit="m/s", note=note, says_nothing=void,
                ours=float(bench.after_release(trace.velocity)[tripped[0]]) if tripped.size else None,
            )  # fmt: skip
    for name in ("hsc", "wsc"):
        yield PaperRow(
            source="Fig. 11", quantity="vfc_over_controller", controller=name, stiffness=STIFFNESS, depth=DEPTH,
        paper=2.0,
            ours=mev["vfc-both"] / mev[name] if mev[name] > 0.0 else None, unit="1",
            says_nothing=voids["vfc-both"] or voids[name],
            note=f'"almost two times"; VFC by its text; {met_by(f"Fig. 11 {name}")}',
        )  # fmt: skip


def table_1_rows(bench: Bench) -> Iterator[PaperRow]:
    """Yield section 4.4, Table 1: WSC over the window."""
    for window, paper in zip(WINDOWS, TABLE_1, strict=True):
        trace = bench.press(bench.law("wsc", window=window))
        yield PaperRow(
            source="Table 1", quantity="max_ejection_velocity", controller="wsc", window=window,
            stiffness=STIFFNESS, depth=DEPTH, paper=paper, ours=bench.ejection(trace), unit="m/s",
            says_nothing=held_trip(trace, bench.release_tick),
            note=met_by("Table 1"),
        )  # fmt: skip


def active_force_rows(bench: Bench) -> Iterator[PaperRow]:
    """Yield section 4.5, Fig. 12 to 15: a sinusoidal force, gripped and released."""
    free = bench.free()
    yield PaperRow(
        source="Fig. 12", quantity="speed_at_0.17_s", controller="none", amplitude_n=1.0, paper=1.1,
        ours=float(free.velocity[170]), unit="m/s",
        note="sin(5 t) N gives a free mass of 0.157 kg at most (1 - cos 5t) / 5m = 0.43 m/s by then; "
        + met_by("Fig. 12"),
    )  # fmt: skip
    release = round(ACTIVE_RELEASE_S / PERIOD_S)
    default = bench.law("hsc")
    raised = bench.law("hsc", hsc_force_threshold_n=RAISED_FORCE_THRESHOLD_N)
    runs = (
        ("none", None, None, "Fig. 12", None, ""),
        ("wsc", bench.law("wsc", energy_threshold_j=ACTIVE_THRESHOLD_J), None, "Fig. 14", 0.18, ""),
        ("hsc", default, None, "Fig. 15b", 0.3, GRIP_YIELDS),
        ("hsc", raised, RAISED_FORCE_THRESHOLD_N, "Fig. 15b", 0.3, "F_t above what the grip has not taken up"),
    )
    for name, settings, force_threshold_n, source, paper, note in runs:
        trace = bench.active(1.0, settings, ACTIVE_RELEASE_S)
        window = 100 if name == "wsc" else None
        early = (trace.tripped[:release] > 0).any()
        yield PaperRow(
            source=f"{source}b" if name == "wsc" else source, quantity="max_ejection_velocity", controller=name,
            amplitude_n=1.0, window=window, force_threshold_n=force_threshold_n, paper=paper,
            relation="<" if name == "hsc" else "=", ours=float(np.abs(trace.velocity[release:]).max()), unit="m/s",
            note=note, says_nothing="tripped before the release" if early else "",
        )  # fmt: skip
        if settings is not None:
            yield PaperRow(
                source=f"{source}a" if name == "wsc" else source, quantity="time_of_trip", controller=name,
                amplitude_n=1.0, window=window, force_threshold_n=force_threshold_n, paper=ACTIVE_RELEASE_S,
                ours=first_time(trace.tripped > 0), unit="s", note=note,
            )  # fmt: skip
    for amplitude in AMPLITUDES_N:
        trace = bench.active(amplitude, WATCHED, None)
        yield PaperRow(
            source="Fig. 13" if amplitude == 1.0 else "Fig. 14c", quantity="least_energy_gripped",
            controller="wso", window=100, amplitude_n=amplitude,
            paper=ACTIVE_THRESHOLD_J if amplitude == 1.0 else None, relation=">",
            ours=float(trace.windowed_energy_j.min()), unit="J", note="grows with the amplitude; no trip at 1 N",
        )  # fmt: skip
    for amplitude in AMPLITUDES_N:
        trace = bench.active(amplitude, WATCHED, None)
        pushing = np.abs(trace.rendered_force) > 0.1
        yield PaperRow(
            source="Fig. 15a" if amplitude == 1.0 else "Fig. 15c", quantity="median_grasp_ratio_gripped",
            controller="hgo", amplitude_n=amplitude, paper=1.0,
            ours=float(np.median(trace.grasp[pushing])), unit="1", note="where |F_v| > F_t = 0.1 N",
        )  # fmt: skip


EXPERIMENTS: tuple[Callable[[Bench], Iterator[PaperRow]], ...] = (
    ejection_rows,
    lambda bench: closed_form_rows(bench.operator),
    observer_rows,
    controller_rows,
    table_1_rows,
    active_force_rows,
)
"""Experiments in row order."""
