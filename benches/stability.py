"""Where simulated loops lose their stability, against closed forms: sampled walls, delayed springs, position-force.

Every loop here has one gain K and the characteristic equation K + h(s) = 0. The first root that leaves the stable
region does so at the least K = -Re h(j w) > 0 with Im h(j w) = 0 (D-decomposition). At the simulated gain a free
oscillation neither grows nor decays; bisection on its measured growth finds it.

Rows: the wall of a sampled device (Colgate and Schenkel 1994; Gil et al. 2004), the delayed spring m x'' + b x' + K x(t
- tau) = 0, and position-force coupling with and without a round trip (Daniel and McAree 1998). A row that is off by
more than 1 % fails.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.optimize
from rich.console import Console
from rich.progress import track

from _report import bench_options, print_table, table_file, write_json
from haptether.bridge import Scene, simulate

Array: TypeAlias = npt.NDArray[np.float64]
Complex: TypeAlias = npt.NDArray[np.complex128]
Curve: TypeAlias = Callable[[Array], Complex]
"""h(j w) of the characteristic equation K + h = 0, over w in rad/s."""

EXAMPLE = "example: python benches/stability.py --only wall --json -"
TOLERANCE = 0.01
SEED = 7
CLIP = 5.0
"""Growth beyond e^5 gives only its sign."""
AMPLITUDE = 1e-6
"""Amplitude in m of the free oscillation: nothing saturates."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Critical:
    """Edge of a loop's stability."""

    gain: float
    frequency: float
    """Frequency in rad/s."""
    slope: float
    """Growth of the oscillation in 1/s per unit of gain."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """Loop with a gain: its closed form, its sampled form, and its scene."""

    name: str
    unit: str
    closed: Critical
    sampled: Critical
    printed: float | None
    """Rounded value of the reference."""
    scene: Callable[[float, float, int], dict[str, Any]]
    """Returns a scene from gain, duration in s and ticks between samples."""
    period_s: float
    begin_s: float
    """Time at which the excitation is over."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the table."""

    name: str
    unit: str
    printed: float | None
    closed: float
    sampled: float
    simulated: float
    error: float
    """Relative error of the simulated gain against the closed form."""
    ticks: int


# Closed forms


def first_crossing(curve: Curve, min_rad_s: float, max_rad_s: float) -> Critical:
    """Return the least positive gain with a root on the edge, among frequencies from `min_rad_s` to `max_rad_s`."""
    grid = np.geomspace(min_rad_s, max_rad_s, 40_000)
    imaginary = curve(grid).imag
    found: list[Critical] = []
    for index in np.flatnonzero(np.sign(imaginary[:-1]) != np.sign(imaginary[1:])):
        low, high = float(grid[index]), float(grid[index + 1])
        w = float(scipy.optimize.brentq(lambda w: float(curve(np.array([w]))[0].imag), low, high, xtol=1e-13 * high))
        gain = -float(curve(np.array([w]))[0].real)
        if gain > 0.0:
            step = 1e-5 * w
            before, after = curve(np.array([w - step, w + step]))
            slope = float((-1j * 2.0 * step / (after - before)).real)
            found.append(Critical(gain=gain, frequency=w, slope=slope))
    return min(found, key=lambda one: one.gain)


def device_response(mass_kg: float, viscous: float, period_s: float, z: Complex) -> tuple[Complex, Complex]:
    """Return x(z) and V(z) of `1 / (m s² + b s)` behind a zero-order hold."""
    if viscous == 0.0:
        decay, glide = 1.0, period_s
        gains = (0.5 * period_s**2 / mass_kg, period_s / mass_kg)
    else:
        rate = viscous / mass_kg
        decay = float(np.exp(-rate * period_s))
        glide = -float(np.expm1(-rate * period_s)) / rate
        gains = ((period_s - glide) / viscous, glide / mass_kg)
    velocity = gains[1] / (z - decay)
    return (gains[0] + glide * velocity) / (z - 1.0), velocity


def wall(mass_kg: float, viscous: float, damping: float, period_s: float, late: int) -> Curve:
    """Return the curve of a sampled wall of stiffness K, damped by differences, `late` ticks late."""

    def curve(w: Array) -> Complex:
        z = np.exp(1j * w * period_s)
        position, _ = device_response(mass_kg, viscous, period_s, z)
        h: Complex = z**late / position + damping * (1.0 - 1.0 / z) / period_s
        return h

    return curve


def delayed_spring(mass_kg: float, viscous: float, delay_s: float) -> Critical:
    """Solve `w tan(w tau) = b / m`, `K = b w / sin(w tau)`."""
    ratio = viscous / mass_kg
    w = float(
        scipy.optimize.brentq(
            lambda w: w * np.sin(w * delay_s) - ratio * np.cos(w * delay_s), 1e-9, 0.5 * np.pi / delay_s, xtol=1e-13
        )
    )
    gain = float(viscous * w / np.sin(w * delay_s))
    slope = first_crossing(lambda w: np.exp(1j * w * delay_s) * (1j * w * viscous - mass_kg * w**2), w / 2, w * 2).slope
    return Critical(gain=gain, frequency=w, slope=slope)


@dataclass(frozen=True, slots=True, kw_only=True)
class Teleoperator:
    """Position-force coupling of a free device with an arm on a spring."""

    master_kg: float
    master_viscous: float
    slave_kg: float
    stiffness: float
    damping: float
    spring: float
    """K_e in N/m."""

    def continuous(self, round_trip_s: float) -> Curve:
        """Return the curve of the gain lambda, with measured force."""

        def curve(w: Array) -> Complex:
            s = 1j * w
            master = self.master_kg * s**2 + self.master_viscous * s
            slave = self.slave_kg * s**2 + self.damping * s + self.stiffness + self.spring
            h: Complex = np.exp(s * round_trip_s) * master * slave
            return h / (self.spring * (self.damping * s + self.stiffness))

        return curve

    def sampled(self, period_s: float, late: int) -> Curve:
        """Return the same with both ends sampled and held, and a round trip of `late` ticks."""
        per_kg = np.array([self.stiffness, self.damping]) / self.slave_kg
        generator = np.zeros((4, 4))
        generator[0, 1] = 1.0
        generator[1] = [-(self.stiffness + self.spring) / self.slave_kg, -self.damping / self.slave_kg, *per_kg]
        step = scipy.linalg.expm(generator * period_s)
        (a, b), (c, d) = step[0, :2], step[1, :2]

        def curve(w: Array) -> Complex:
            z = np.exp(1j * w * period_s)
            response = device_response(self.master_kg, self.master_viscous, period_s, z)
            pushes = [step[row, 2] * response[0] + step[row, 3] * response[1] for row in (0, 1)]
            position = ((z - d) * pushes[0] + b * pushes[1]) / ((z - a) * (z - d) - b * c)
            h: Complex = z**late / (self.spring * position)
            return h

        return curve

    def critical(self, round_trip_s: float) -> Critical:
        """Return the edge of the continuous loop."""
        if round_trip_s == 0.0 and self.master_viscous == 0.0:
            # lambda = M_m / M_s for any other values: here Im h vanishes at w = sqrt(K_e / M_s).
            w = float(np.sqrt(self.spring / self.slave_kg))
            return first_crossing(self.continuous(0.0), 0.5 * w, 2.0 * w)
        return first_crossing(self.continuous(round_trip_s), 1e-2, 1e5 if round_trip_s == 0.0 else 60.0 / round_trip_s)


# Scenes


def common(period_s: float, duration_s: float, every: int) -> dict[str, Any]:
    """Return the common part of all scenes: nobody holds, no controller, no limit of the force."""
    return {
        "schema": 1,
        "run": {"duration_s": duration_s, "period_s": period_s},
        "safety": {"estimator": {"kind": "backward-difference"}, "limiter": {"enabled": False}},
        "record": {"every": every},
    }


def wall_scene(
    mass_kg: float, viscous: float, damping: float, period_s: float, late: int
) -> Callable[[float, float, int], dict[str, Any]]:
    """Return scenes of a device that is released beside a spring with delay."""

    def scene(stiffness: float, duration_s: float, every: int) -> dict[str, Any]:
        spring = {"shape": {"kind": "spring"}, "contact": {"stiffness": stiffness, "damping": damping}}
        return common(period_s, duration_s, every) | {
            "master": {"mass_kg": mass_kg, "viscous": viscous, "position": AMPLITUDE, "measures_velocity": True},
            "environment": {"delay_ticks": late, "objects": [spring]},
        }

    return scene


PUSH_S = 0.02


def teleoperator_scene(
    plant: Teleoperator, period_s: float, delays: tuple[int, int]
) -> Callable[[float, float, int], dict[str, Any]]:
    """Return scenes with both endpoints, `delays` in ticks apart; after engagement and fade-in the arm is pushed."""
    forward, backward = (round(ticks * period_s, 12) for ticks in delays)

    def scene(force_scale: float, duration_s: float, every: int) -> dict[str, Any]:
        spring = {"shape": {"kind": "spring"}, "contact": {"stiffness": plant.spring}}
        push = {"at_s": 0.25, "duration_s": PUSH_S, "force_n": AMPLITUDE * (plant.stiffness + plant.spring)}
        return common(period_s, duration_s, every) | {
            "master": {
                "mass_kg": plant.master_kg, "viscous": plant.master_viscous, "position": 0.0, "measures_velocity": True
            },
            "slave": {
                "control": "pd", "mass_kg": plant.slave_kg, "stiffness": plant.stiffness, "damping": plant.damping,
                "max_speed": "unbounded",
            },
            "environment": {"objects": [spring], "pushers": [push]},
            "link": {"forward": {"delay_s": forward}, "backward": {"delay_s": backward}},
            "coupling": {"force_scale": force_scale},
        }  # fmt: skip

    return scene


# Cases

WALLS = (
    # T in s, ticks late, K printed for B = 0 and B = 2
    (1e-3, 0, 1000.83, 4905.3),
    (1e-3, 1, 333.80, 1632.0),
    (1e-3, 2, 200.43, 974.1),
    (1e-3, 5, 91.33, 434.9),
    (1e-3, 10, 48.03, 220.5),
    (1e-3, 50, 10.30, 31.0),
    (2e-3, 0, 500.83, 2406.5),
    (2e-3, 10, 24.22, 100.9),
)
DELAYS_S = (1e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5)
SPRINGS = (
    # m, b, K printed for each delay
    (0.1, 0.5, (500.4, 50.41, 25.41, 10.40, 5.374, 2.837, 1.256)),
    (0.1, 5.0, (5041.0, 537.4, 283.7, 125.6, 67.92, 36.09, 15.13)),
    (1.0, 5.0, (5004.0, 504.1, 254.1, 103.9, 53.74, 28.37, 12.56)),
)
DAMPED = (
    # B_m, lambda printed for K_e of 1e2, 1e3, 1e4, 1e5
    (1.0, (0.45, 0.09, 0.054, 0.0504)),
    (5.0, (3.23, 0.383, 0.0876, 0.054)),
    (20.0, (34.9, 3.61, 0.444, 0.0945)),
)
ROUND_TRIPS = (
    (0.5e-3, 0.369), (2e-3, 0.334), (5e-3, 0.284), (10e-3, 0.232), (20e-3, 0.178), (50e-3, 0.124),
    (100e-3, 0.0988), (200e-3, 0.0739), (500e-3, 0.0358),
)  # fmt: skip


def wall_cases() -> Iterator[Case]:
    """Yield section 4.1: the closed form is that of the sampled loop."""
    mass_kg, viscous = 0.1, 0.5
    for period_s, late, *printed in WALLS:
        for damping, figure in zip((0.0, 2.0), printed, strict=True):
            curve = wall(mass_kg, viscous, damping, period_s, late)
            exact = first_crossing(curve, 1e-2, np.pi / period_s * (1.0 - 1e-9))
            yield Case(
                name=f"wall, T {period_s * 1e3:g} ms, {late} late, B {damping:g}",
                unit="N/m",
                closed=exact,
                sampled=exact,
                printed=figure,
                scene=wall_scene(mass_kg, viscous, damping, period_s, late),
                period_s=period_s,
                begin_s=0.0,
            )


SPRING_TICKS = 49
"""Delay of the sampled spring in ticks; the hold adds half a tick."""


def spring_cases() -> Iterator[Case]:
    """Yield section 4.2, with a period so short that the hold acts as half a period of delay."""
    for mass_kg, viscous, printed in SPRINGS:
        for delay_s, figure in zip(DELAYS_S, printed, strict=True):
            period_s = round(delay_s / (SPRING_TICKS + 0.5) * 1e9) * 1e-9
            curve = wall(mass_kg, viscous, 0.0, period_s, SPRING_TICKS)
            yield Case(
                name=f"delayed spring, m {mass_kg:g}, b {viscous:g}, {delay_s * 1e3:g} ms",
                unit="N/m",
                closed=delayed_spring(mass_kg, viscous, delay_s),
                sampled=first_crossing(curve, 1e-2, np.pi / period_s * (1.0 - 1e-9)),
                printed=figure,
                scene=wall_scene(mass_kg, viscous, 0.0, period_s, SPRING_TICKS),
                period_s=period_s,
                begin_s=2.0 * delay_s,
            )


PERIODS_S = (1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5)


def teleoperator_case(
    name: str, plant: Teleoperator, round_trip_s: float, printed: float | None, *, within: float = 2e-3
) -> Case:
    """Return a case sampled as coarsely as keeps its critical gain within a share of the continuous one.

    Both holds together are one period of delay. A wire without delay adds another: the master receives a tick of the
    slave at its next tick.
    """
    closed = plant.critical(round_trip_s)
    for period_s in PERIODS_S:
        round_trip = round(round_trip_s / period_s) - 1 if round_trip_s > 0.0 else 1
        if round_trip < 1:
            continue
        delays = (round_trip // 2, round_trip - round_trip // 2) if round_trip_s > 0.0 else (0, 0)
        curve = plant.sampled(period_s, round_trip)
        sampled = first_crossing(curve, closed.frequency * 1e-2, np.pi / period_s * (1.0 - 1e-9))
        if abs(sampled.gain / closed.gain - 1.0) < within:
            break
    return Case(
        name=name,
        unit="",
        closed=closed,
        sampled=sampled,
        printed=printed,
        scene=teleoperator_scene(plant, period_s, delays),
        period_s=period_s,
        begin_s=0.3 + PUSH_S + 3.0 * round_trip_s,
    )


def teleoperator_cases(plants: int = 4, *, within: float = 2e-3) -> Iterator[Case]:
    """Yield section 4.3; `within` as in `teleoperator_case`."""
    draw = np.random.default_rng(SEED)
    for number in range(plants):
        masses = np.exp(draw.uniform(np.log([0.05, 0.5]), np.log([1.0, 5.0])))
        stiffness, spring = np.exp(draw.uniform(np.log(300.0), np.log(5000.0), size=2))
        damping = draw.uniform(0.3, 1.5) * 2.0 * np.sqrt(stiffness * masses[1])
        plant = Teleoperator(
            master_kg=float(masses[0]), master_viscous=0.0, slave_kg=float(masses[1]),
            stiffness=float(stiffness), damping=float(damping), spring=float(spring),
        )  # fmt: skip
        yield teleoperator_case(
            f"position-force, plant {number}, M_m / M_s", plant, 0.0, masses[0] / masses[1], within=within
        )
    for viscous, printed in DAMPED:
        for spring, figure in zip((1e2, 1e3, 1e4, 1e5), printed, strict=True):
            name = f"position-force, B_m {viscous:g}, K_e {spring:g}"
            yield teleoperator_case(name, damped_plant(viscous, spring), 0.0, figure, within=within)
    for round_trip_s, figure in ROUND_TRIPS:
        name = f"position-force, round trip {round_trip_s * 1e3:g} ms"
        yield teleoperator_case(name, damped_plant(5.0, 1e3), round_trip_s, figure, within=within)


def damped_plant(viscous: float, spring: float) -> Teleoperator:
    """Return the plant of the reference's tables."""
    return Teleoperator(
        master_kg=0.1, master_viscous=viscous, slave_kg=2.0, stiffness=800.0, damping=80.0, spring=spring
    )


# Measurements


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """Two spans of whole periods of the oscillation, whole periods apart."""

    first_s: float
    span_s: float
    apart_s: float

    @classmethod
    def of(cls, case: Case) -> "Windows":
        """Return windows so far apart that 1 % of gain changes the amplitude by 5 %."""
        period_s = 2.0 * np.pi / case.sampled.frequency
        rate = abs(case.sampled.slope) * 0.01 * case.sampled.gain
        periods = max(12, int(np.ceil(0.05 / (rate * period_s))))
        return cls(first_s=case.begin_s + 8.0 * period_s, span_s=4.0 * period_s, apart_s=periods * period_s)

    @property
    def end_s(self) -> float:
        """Time at which the second window ends."""
        return self.first_s + self.apart_s + self.span_s


def growth(case: Case, windows: Windows, gain: float) -> float:
    """Return the logarithm of the amplitude ratio of the two windows."""
    every = max(1, int(2.0 * np.pi / case.sampled.frequency / case.period_s / 200.0))
    duration_s = windows.end_s + 2.0 * case.period_s * every
    run = simulate(msgspec.convert(case.scene(gain, duration_s, every), Scene))
    if run.metrics.diverged:
        return CLIP
    time_s, position = run.signals["time_s"], run.signals["position"]

    def energy(begin_s: float) -> float:
        return float(np.mean(position[(time_s >= begin_s) & (time_s < begin_s + windows.span_s)] ** 2))

    early, late = energy(windows.first_s), energy(windows.first_s + windows.apart_s)
    if early == 0.0:
        message = f"{case.name}: nothing moves at gain {gain:g}; events: {run.events}"
        raise RuntimeError(message)
    return float(np.clip(0.5 * np.log(max(late, 1e-300) / early), -CLIP, CLIP))


def measure(case: Case, tolerance: float = 5e-4) -> Row:
    """Bisect the simulated edge of stability to a relative `tolerance`."""
    windows = Windows.of(case)

    def grows(gain: float) -> float:
        return growth(case, windows, gain)

    low, high = 0.9 * case.sampled.gain, 1.1 * case.sampled.gain
    if not grows(low) < 0.0 < grows(high):
        low, high = 0.5 * case.sampled.gain, 2.0 * case.sampled.gain
    simulated = float("nan")
    if grows(low) < 0.0 < grows(high):
        simulated = float(scipy.optimize.brentq(grows, low, high, xtol=tolerance * low))
    return Row(
        name=case.name,
        unit=case.unit,
        printed=case.printed,
        closed=case.closed.gain,
        sampled=case.sampled.gain,
        simulated=simulated,
        error=simulated / case.closed.gain - 1.0,
        ticks=round(windows.end_s / case.period_s),
    )


CASES: dict[str, Callable[[], Iterator[Case]]] = {
    "wall": wall_cases,
    "spring": spring_cases,
    "position-force": teleoperator_cases,
}


def main() -> int:
    """Measure, print, and check every row."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--only", choices=CASES, help="one of the tables; default all")
    arguments = options.parse_args()

    out = table_file(arguments.json)
    cases = [case for name, make in CASES.items() if arguments.only in {None, name} for case in make()]
    rows = [measure(case) for case in track(cases, "stability", console=Console(stderr=True), transient=True)]

    print("critical gain: stiffness in N/m, force scale of position-force", file=out)
    print("sampled: closed form of the loop as it is sampled; error: simulated against closed form\n", file=out)
    lines = (
        (row.name, row.printed and f"{row.printed:.4g}",
         *(f"{gain:.5g}" for gain in (row.closed, row.sampled, row.simulated)), f"{row.error:+.2%}",
         "" if abs(row.error) <= TOLERANCE else "OFF")
        for row in rows
    )  # fmt: skip
    print_table(("", "printed", "closed", "sampled", "simulated", "error", ""), lines, out)
    off = [row.name for row in rows if not abs(row.error) <= TOLERANCE]
    print(f"\n{len(rows) - len(off)} of {len(rows)} rows within {TOLERANCE:.0%}", file=out)
    write_json(
        arguments.json, {"tolerance": TOLERANCE, "seed": SEED, "rows": [asdict(row) for row in rows], "met": not off}
    )
    return 1 if off else 0


if __name__ == "__main__":
    sys.exit(main())
