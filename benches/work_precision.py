"""Run time against error of the engine, which is exact, beside methods with steps and SciPy's DOP853.

Each scenario is one axis with dT = 1 ms. The reference shares no line with ours: a closed form, a recursion in extended
precision, or DOP853 at 1e-13, piece by piece between located events (`_piecewise.py`).

The methods with steps are those of `_stepped.py`: bare loops, compiled by Numba (`haptether[bench]`). The engine must
lie on the Pareto front of every scenario: no method may be at least as accurate and faster.
"""

import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from math import cos, pi, sin, sqrt
from pathlib import Path
from typing import TextIO, TypeVar

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace
from rich.console import Console
from rich.progress import track

from _piecewise import Motion, integrate, recursion, tick_by_tick, ticks_of
from _report import add_number, bench_options, print_table, table_file, write_json
from _stepped import METHODS, Method, step
from haptether.bridge import (
    ContactTable,
    EnvironmentTable,
    LegTable,
    LimiterTable,
    MasterTable,
    ObjectTable,
    OperatorTable,
    PusherTable,
    RecordTable,
    ReleaseTable,
    Run,
    RunTable,
    SafetyTable,
    Scene,
    simulate,
)

Array = npt.NDArray[np.float64]
Done = TypeVar("Done")

EXAMPLE = "example: python benches/work_precision.py --json - --plot out"
EXACT = "exact"
STEPS_S = (1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5)
MASS_KG, VISCOUS, COULOMB_N = 0.157, -0.005, 0.038
OTHER_STEP_S = 0.61e-3
"""Longest step of the DOP853 run that estimates the reference's accuracy."""
REQUIRED = 1e-12
CONTACTS = 10_000
UNWATCHED = SafetyTable(signals="true", limiter=LimiterTable(enabled=False))


# Scenarios


def wall(stiffness: float, damping: float = 0.0) -> tuple[ObjectTable, ...]:
    """Return a wall that fills x < 0."""
    return (ObjectTable(contact=ContactTable(stiffness=stiffness, damping=damping)),)


def throw() -> Scene:
    """A wall pressed by 39 mm throws a bare mass: one contact to leave in time, then straight flight."""
    return Scene(
        schema=1,
        run=RunTable(duration_s=1.0),
        master=MasterTable(mass_kg=MASS_KG, position=-0.039),
        environment=EnvironmentTable(rendering="continuous", objects=wall(200.0)),
        safety=UNWATCHED,
    )


def bounces() -> Scene:
    """A steady force drops a bare mass on a damped wall: eighteen contacts, whose errors in time add up."""
    return Scene(
        schema=1,
        run=RunTable(duration_s=3.0),
        master=MasterTable(mass_kg=MASS_KG, position=0.02),
        environment=EnvironmentTable(
            rendering="continuous", objects=wall(1000.0, 0.5), pushers=(PusherTable(force_n=-0.5),)
        ),
        safety=UNWATCHED,
    )


def path() -> Scene:
    """A hand leads the device along its path, with nothing to touch: smooth, so that each method has its order."""
    return Scene(
        schema=1,
        run=RunTable(duration_s=2.0),
        master=MasterTable(mass_kg=MASS_KG, viscous=VISCOUS),
        operator=OperatorTable(
            start=0.02, legs=(LegTable(duration_s=0.8, end=-0.045), LegTable(duration_s=0.6, end=-0.03))
        ),
        safety=UNWATCHED,
    )


def press(coulomb: float = 0.0) -> Scene:
    """A hand presses a damped wall, eases, and lets go over 50 ms: contact, and a grip that slips."""
    scene = path()
    hand = scene.operator
    assert hand is not None
    return replace(
        scene,
        run=RunTable(duration_s=2.5),
        master=replace(scene.master, coulomb=coulomb),
        operator=replace(hand, grip_strength_n=6.0, release=ReleaseTable(at_s=1.7, decay_s=0.05)),
        environment=EnvironmentTable(rendering="continuous", objects=wall(200.0, 1.0)),
    )


def rub() -> Scene:
    """The same with friction that holds the device at rest, gives way, turns with the motion and stops it."""
    return press(COULOMB_N)


def held() -> Scene:
    """A hand pushes the device into a wall that is sampled and held over each tick: linear within every tick."""
    return Scene(
        schema=1,
        run=RunTable(duration_s=2.0),
        master=MasterTable(mass_kg=MASS_KG, viscous=VISCOUS, position=0.02),
        operator=OperatorTable(stiffness=300.0, damping=1.0, start=-0.02),
        environment=EnvironmentTable(objects=wall(1000.0)),
        safety=UNWATCHED,
    )


def thrown(scene: Scene) -> Motion:
    """Return the closed form of `throw`: `-D cos(w t)` for a quarter of a period, then `w D`."""
    depth, rate = 0.039, sqrt(200.0 / MASS_KG)
    leaves = 0.5 * pi / rate
    time_s = ticks_of(scene)
    position = [-depth * cos(rate * t) if t < leaves else rate * depth * (t - leaves) for t in time_s.tolist()]
    velocity = [rate * depth * (sin(rate * t) if t < leaves else 1.0) for t in time_s.tolist()]
    return Motion(
        time_s=time_s, position=np.array(position), velocity=np.array(velocity), met_s=(), left_s=(leaves,), pieces=2
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """Scene, its reference, and the equivalent in SciPy."""

    name: str
    scene: Scene
    reference: Callable[[Scene], Motion]
    scipy: Callable[[Scene], Motion] = integrate
    energy_j: float | None = None
    """m V² / 2 at the end, if a closed form gives it."""
    note: str = ""


def scenarios() -> list[Scenario]:
    """Return all rows of the table."""
    other = partial(integrate, max_step_s=OTHER_STEP_S)
    return [
        Scenario(name="throw", scene=throw(), reference=thrown, energy_j=0.5 * 200.0 * 0.039**2),
        Scenario(name="bounces", scene=bounces(), reference=other),
        Scenario(name="path", scene=path(), reference=other),
        Scenario(name="press and let go", scene=press(), reference=other),
        Scenario(
            name="the same, rubbing",
            scene=rub(),
            reference=other,
            note="Steps cannot hold a device at rest: friction is c V / V_f below V_f = 1 mm/s, which bounds their"
            " error from below, whatever the step.",
        ),
        Scenario(name="sampled and held", scene=held(), reference=recursion, scipy=tick_by_tick),
    ]


# Measurements


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Time per simulated second, and errors: largest at any tick, of the peak, of the last contact's end."""

    method: str
    step_s: float | None
    us_per_s: float
    scipy_ratio: float
    position_m: float
    peak_velocity: float
    contact_s: float | None
    energy: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """All scores of one scenario; `dominated_by`: methods that beat the engine."""

    scenario: str
    stresses: str
    note: str
    simulated_s: float
    scipy_us_per_s: float
    scipy_error_m: float
    scores: list[Score]
    dominated_by: list[str]


def ran(scene: Scene, *, recorded: bool = True) -> Run:
    """Run the engine once."""
    return simulate(replace(scene, record=RecordTable() if recorded else None))


def seconds(scene: Scene, repeats: int) -> float:
    """Return the engine's time without records: least of the repeats, minus that of a scene of one tick."""
    one = replace(scene, run=replace(scene.run, duration_s=scene.run.period_s))
    whole, start = (min(ran(some, recorded=False).metrics.wall_time_s for _ in range(repeats)) for some in (scene, one))
    return whole - start


def timed(compute: Callable[[], Done], repeats: int) -> tuple[Done, float]:
    """Return a call's result, and its time in s, least of the repeats."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        done = compute()
        times.append(time.perf_counter() - begun)
    return done, min(times)


@dataclass(frozen=True, slots=True, kw_only=True)
class Computed:
    """Motion, last time in s that the wall was left, and computing time in s."""

    method: str
    step_s: float | None = None
    position: Array
    velocity: Array
    left_s: float | None
    took_s: float


def by_engine(scene: Scene, repeats: int) -> Computed:
    """Return the engine's motion."""
    run = ran(scene)
    return Computed(
        method=EXACT,
        position=run.signals.position,
        velocity=run.signals.velocity,
        left_s=max((event.time_s for event in run.events if event.kind == "free"), default=None),
        took_s=seconds(scene, repeats),
    )


def by_steps(scene: Scene, method: Method, step_s: float, repeats: int) -> Computed:
    """Return the motion of a fixed-step method."""
    done, took_s = timed(partial(step, scene, method, step_s, numba=True), repeats)
    return Computed(
        method=method, step_s=step_s, position=done.position, velocity=done.velocity, left_s=done.left_s, took_s=took_s
    )


def score(scenario: Scenario, truth: Motion, found: Computed, scipy_s: float) -> Score:
    """Compare a motion with the true one."""
    energy = None
    if scenario.energy_j is not None:
        energy = abs(0.5 * MASS_KG * float(found.velocity[-1]) ** 2 / scenario.energy_j - 1.0)
    return Score(
        method=found.method,
        step_s=found.step_s,
        us_per_s=found.took_s * 1e6 / scenario.scene.run.duration_s,
        scipy_ratio=scipy_s / found.took_s,
        position_m=float(np.abs(found.position - truth.position).max()),
        peak_velocity=abs(float(np.abs(found.velocity).max() - np.abs(truth.velocity).max())),
        contact_s=abs(found.left_s - truth.left_s[-1]) if found.left_s is not None and truth.left_s else None,
        energy=energy,
    )


def measure(scenario: Scenario, repeats: int, scipy_repeats: int) -> Panel:
    """Measure all methods of one scenario."""
    truth, scene = scenario.reference(scenario.scene), scenario.scene
    peer, scipy_s = timed(partial(scenario.scipy, scene), scipy_repeats)
    floor = float(np.abs(peer.position - truth.position).max())
    found = [by_engine(scene, repeats)]
    found += [by_steps(scene, method, step_s, repeats) for method in METHODS for step_s in STEPS_S]
    ours, *peers = (score(scenario, truth, one, scipy_s) for one in found)
    # Below the accuracy of the reference no method is better than another.
    known = 0.0 if scenario.reference in (thrown, recursion) else floor
    dominated_by = [
        f"{one.method} at {one.step_s:g} s"
        for one in peers
        if max(one.position_m, known) <= max(ours.position_m, known) and one.us_per_s < ours.us_per_s
    ]
    return Panel(
        scenario=scenario.name,
        stresses=STRESSES[scenario.name],
        note=scenario.note,
        simulated_s=scene.run.duration_s,
        scipy_us_per_s=scipy_s * 1e6 / scene.run.duration_s,
        scipy_error_m=floor,
        scores=[ours, *peers],
        dominated_by=dominated_by,
    )


STRESSES = {
    one.name: (function.__doc__ or "").strip()
    for one, function in zip(scenarios(), (throw, bounces, path, press, rub, held), strict=True)
}


def release_errors() -> dict[float, float]:
    """Return the relative velocity error when an undamped wall of K throws a bare mass from depth D: sqrt(K/m) D."""
    errors = {}
    for stiffness in np.logspace(1, 6, 21).tolist():
        depth = min(7.8 / stiffness, 0.05)
        scene = throw()
        scene = replace(
            scene,
            master=replace(scene.master, position=-depth),
            environment=EnvironmentTable(rendering="continuous", objects=wall(stiffness)),
        )
        velocity = float(ran(scene).signals.velocity[-1])
        errors[stiffness] = abs(velocity / (sqrt(stiffness / MASS_KG) * depth) - 1.0)
    return errors


def bounce_error(contacts: int = CONTACTS) -> tuple[float, int]:
    """Return the largest relative energy error of an undamped bounce, and the number of contacts."""
    height, force, stiffness = 1e-3, 1.0, 1e5
    # Up and down, and the contact: half a period, and the part that the force adds.
    lasts = 2.0 * sqrt(2.0 * height * MASS_KG / force) + 1.1 * pi * sqrt(MASS_KG / stiffness)
    scene = Scene(
        schema=1,
        run=RunTable(duration_s=round(1.01 * contacts * lasts, 3)),
        master=MasterTable(mass_kg=MASS_KG, position=height),
        environment=EnvironmentTable(
            rendering="continuous", objects=wall(stiffness), pushers=(PusherTable(force_n=-force),)
        ),
        safety=UNWATCHED,
    )
    signals = ran(scene).signals
    x, v = signals.position, signals.velocity
    energy = 0.5 * MASS_KG * v * v + 0.5 * stiffness * np.minimum(x, 0.0) ** 2 + force * x
    made = int(np.count_nonzero((x[1:] <= 0.0) & (x[:-1] > 0.0)))
    return float(np.abs(energy / (force * height) - 1.0).max()), made


# Output


def figures(value: float | None, form: str = ".1e") -> str:
    """Format a number of the table, or a dash."""
    return "-" if value is None else format(value, form)


def report(panels: Iterable[Panel], out: TextIO) -> None:
    """Print the tables."""
    for panel in panels:
        print(f"{panel.scenario}: {panel.stresses}", file=out)
        if panel.note:
            print(panel.note, file=out)
        lines: list[tuple[object, ...]] = [
            (one.method, figures(one.step_s, "g"), f"{one.us_per_s:.0f}", f"{one.scipy_ratio:.0f}",
             f"{one.position_m:.1e}", f"{one.peak_velocity:.1e}", figures(one.contact_s), figures(one.energy))
            for one in panel.scores
        ]  # fmt: skip
        dop853 = (f"{panel.scipy_us_per_s:.0f}", 1, f"{panel.scipy_error_m:.1e}")
        lines.append(("SciPy DOP853", None, *dop853, None, None, None))
        print_table(("", "step s", "us/s", "SciPy/x", "x m", "peak V m/s", "contact s", "energy"), lines, out)
        print(file=out)
    legend = """us/s: us per simulated second, the least of the repeats; of the engine its call without records, less
that of a scene of one tick (building, JSON, the call itself); SciPy/x: time of DOP853 over it
x: largest error at any tick; peak V: of the largest speed; contact: of the last break of a contact, which is located
by the engine and known to a tick with steps; energy: relative, where a closed form has it
the error of DOP853 is against the closed form or the recursion, else against itself with other steps"""
    print(legend, file=out)


def plot(panels: list[Panel], folder: Path) -> Path:
    """Plot a panel per scenario: run time on x, error on y."""
    import matplotlib as mpl  # noqa: PLC0415 (only when asked for)

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    figure, places = plt.subplots(2, 3, figsize=(13, 8), sharex=True, sharey=True, layout="constrained")
    marks = {EXACT: "k*", "rk4": "C0o-", "velocity-verlet": "C1s-", "semi-implicit-euler": "C2^-"}
    for panel, place in zip(panels, places.flat, strict=True):
        for method, mark in marks.items():
            points = [one for one in panel.scores if one.method == method]
            place.loglog(
                [one.us_per_s for one in points], [max(one.position_m, 1e-18) for one in points], mark,
                label=f"{method} (Haptether)" if method == EXACT else method,
                markersize=13 if method == EXACT else 5, linewidth=1,
            )  # fmt: skip
        place.loglog(panel.scipy_us_per_s, panel.scipy_error_m, "C3D", markersize=7, label="SciPy DOP853 at 1e-13")
        place.set_title(panel.scenario)
        place.grid(color="0.9")
        place.set_axisbelow(True)
    for place in places[1]:
        place.set_xlabel("run time in µs per simulated second")
    for place in places[:, 0]:
        place.set_ylabel("largest error of x in m")
    handles, labels = places[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    folder.mkdir(parents=True, exist_ok=True)
    where = folder / "work_precision.png"
    figure.savefig(where, dpi=110)
    return where


def main() -> int:
    """Measure, print, and check the engine."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--plot", metavar="DIR", type=Path, help="writes work_precision.png there")
    add_number(options, "--repeats", 20, "the least time counts")
    add_number(options, "--scipy-repeats", 3, "of DOP853")
    arguments = options.parse_args()
    if find_spec("numba") is None:
        options.error("the methods with steps need Numba: pip install 'haptether[bench]'")

    out = table_file(arguments.json)
    panels = [
        measure(scenario, arguments.repeats, arguments.scipy_repeats)
        for scenario in track(scenarios(), "scenarios", console=Console(stderr=True), transient=True)
    ]
    report(panels, out)
    releases = release_errors()
    energy, contacts = bounce_error()
    worst = max(releases.values())
    print(
        f"\nrelease velocity against sqrt(K/m) D, K = 10 to 1e6 N/m: relative error {worst:.1e}; "
        f"required under {REQUIRED:g}: {'met' if worst < REQUIRED else 'MISSED'}\n"
        f"energy of an undamped bounce over {contacts} contacts: relative error {energy:.1e}; "
        f"required under {REQUIRED:g}: {'met' if energy < REQUIRED and contacts >= CONTACTS else 'MISSED'}",
        file=out,
    )
    met = worst < REQUIRED and energy < REQUIRED and contacts >= CONTACTS
    for panel in panels:
        if panel.dominated_by:
            met = False
            print(f"{panel.scenario}: {EXACT} is beaten by {', '.join(panel.dominated_by)}", file=out)
    print(f"{EXACT}: {'on every Pareto front' if met else 'NOT on every Pareto front'}", file=out)
    if arguments.plot is not None:
        print(plot(panels, arguments.plot), file=out)
    write_json(
        arguments.json,
        {
            "repeats": arguments.repeats,
            "panels": [asdict(panel) for panel in panels],
            "release_velocity": [{"stiffness": k, "relative_error": error} for k, error in releases.items()],
            "bounce": {"contacts": contacts, "relative_error": energy},
            "met": met,
        },
    )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
