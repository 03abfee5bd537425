"""Cost per sample of controllers, limiter and windowed observer, against NumPy and plain Python.

The requirement: a million one-axis samples through HSC and WSC together in under 0.1 s, best of 5.

Each peer computes the same numbers in the same process and must agree with ours: in NumPy as far as
the step has no feedback, and in plain Python, tick by tick, as a script would have it.
"""

import sys
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Literal

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track

from _report import add_number, bench_options, in_turns, print_table, table_file, write_json
from haptether.safety import (
    DeviceModel,
    Limiter,
    LimiterSettings,
    SafetyController,
    SafetySettings,
    WindowedSafetyObserver,
)

Array = npt.NDArray[np.float64]
Work = Callable[[Array, Array, Array], Array]
Name = Literal["vfc", "hsc", "wsc", "pc"]

EXAMPLE = "example: python benches/safety_step.py --json -"
PERIOD_S = 1e-3
MASS_KG = 0.157
DAMPING, RATIO, WINDOW = 5.0, 0.5, 100
FLOOR_N, GRASP, FORCE_N, ENERGY_J = 1e-3, 1.5, 0.1, -0.03
REQUIRED_SAMPLES, REQUIRED_S, REQUIRED_REPEATS = 1_000_000, 0.1, 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """Timed function, and peers with the same result from velocity, rendered and grasp force."""

    name: str
    ours: Work
    numpy: Work | None = None
    python: Work | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """ns per sample, least and median of the repeats; None without such a peer."""

    name: str
    ns: float
    ns_median: float
    numpy_ns: float | None
    python_ns: float | None


# Peers


def numpy_windowed_energy(velocity: Array, rendered: Array, grasp: Array, window: int = WINDOW) -> Array:
    """Return E_wso of Eq. 11 as a difference of cumulative sums."""
    del rendered
    total = np.cumsum(grasp * velocity)
    total[window:] -= total[:-window].copy()
    return PERIOD_S * total - MASS_KG * velocity**2 / (2 * RATIO)


def numpy_safety_force(velocity: Array, rendered: Array, grasp: Array, *, hsc: bool, wsc: bool) -> Array:
    """Return F_c of Eq. 13 and 14."""
    is_unsafe = np.zeros(len(velocity), dtype=bool)
    if hsc:
        push = np.abs(rendered)
        is_unsafe |= (push / (np.abs(grasp) + FLOOR_N) > GRASP) & (push > FORCE_N)
    if wsc:
        is_unsafe |= numpy_windowed_energy(velocity, rendered, grasp) < ENERGY_J
    return np.where(is_unsafe, -rendered - DAMPING * velocity, 0.0)


def python_windowed_energy(velocity: Array, rendered: Array, grasp: Array, window: int = WINDOW) -> Array:
    """Return E_wso with a running sum over a deque."""
    del rendered
    past, total, energies = deque([0.0] * window), 0.0, []
    for v, f in zip(velocity.tolist(), grasp.tolist(), strict=True):
        past.append(f * v)
        total += f * v - past.popleft()
        energies.append(PERIOD_S * total - MASS_KG * v * v / (2 * RATIO))
    return np.array(energies)


def python_safety_force(velocity: Array, rendered: Array, grasp: Array, *, hsc: bool, wsc: bool) -> Array:
    """Return F_c of Eq. 13 and 14, tick by tick."""
    past, total, forces = deque([0.0] * WINDOW), 0.0, []
    for v, f_v, f_h in zip(velocity.tolist(), rendered.tolist(), grasp.tolist(), strict=True):
        is_unsafe = False
        if hsc:
            is_unsafe = abs(f_v) / (abs(f_h) + FLOOR_N) > GRASP and abs(f_v) > FORCE_N
        if wsc:
            past.append(f_h * v)
            total += f_h * v - past.popleft()
            is_unsafe |= PERIOD_S * total - MASS_KG * v * v / (2 * RATIO) < ENERGY_J
        forces.append(-f_v - DAMPING * v if is_unsafe else 0.0)
    return np.array(forces)


def python_limiter(velocity: Array, rendered: Array, grasp: Array) -> Array:
    """Apply cap, slew and power limit on one axis, without ramp."""
    del grasp
    last, forces = 0.0, []
    for v, requested in zip(velocity.tolist(), rendered.tolist(), strict=True):
        force = min(max(requested, -7.9), 7.9)
        unloaded = last * min(max(force / last, 0.0), 1.0) if last else 0.0
        force = unloaded + min(max(force - unloaded, -1.0), 1.0)
        if force * v > 20.0:
            force = 20.0 / v
        last = force
        forces.append(force)
    return np.array(forces)


# Measurements


def controlled(*names: Name) -> Work:
    """Return F_c of those controllers over all samples."""
    device = DeviceModel(mass_kg=MASS_KG)
    controller = SafetyController(device, SafetySettings(names), period_s=PERIOD_S)

    def run(velocity: Array, rendered: Array, grasp: Array) -> Array:
        controller.reset()
        return controller.run(velocity, rendered, grasp).safety_force

    return run


def limited(velocity: Array, rendered: Array, grasp: Array) -> Array:
    """Run the limiter over all samples."""
    del grasp
    limiter = Limiter(LimiterSettings(ramp_in_s=0.0), period_s=PERIOD_S)
    return limiter.run(rendered, velocity)[0]


def windowed(window: int) -> Work:
    """Run WSO over all samples."""
    device = DeviceModel(mass_kg=MASS_KG)
    observer = WindowedSafetyObserver(device, period_s=PERIOD_S, energy_ratio=RATIO, window=window)

    def run(velocity: Array, rendered: Array, grasp: Array) -> Array:
        observer.reset()
        return observer.run(velocity, rendered, grasp)

    return run


def cases() -> list[Case]:
    """Return all rows of the table."""
    found = [Case(name="VFC", ours=controlled("vfc"))]
    for hsc, wsc in ((True, False), (False, True), (True, True)):
        names: list[Name] = []
        if hsc:
            names.append("hsc")
        if wsc:
            names.append("wsc")
        found.append(
            Case(
                name=" + ".join(names).upper(),
                ours=controlled(*names),
                numpy=partial(numpy_safety_force, hsc=hsc, wsc=wsc),
                python=partial(python_safety_force, hsc=hsc, wsc=wsc),
            )
        )
    found += [
        Case(name="VFC + HSC + WSC + PC", ours=controlled("vfc", "hsc", "wsc", "pc")),
        Case(name="limiter", ours=limited, python=python_limiter),
    ]
    found += [
        Case(
            name=f"WSO, window {window}",
            ours=windowed(window),
            numpy=partial(numpy_windowed_energy, window=window),
            python=partial(python_windowed_energy, window=window),
        )
        for window in (50, 1_000, 100_000)
    ]
    return found


def signals(samples: int) -> tuple[Array, Array, Array]:
    """Return a hand that sways, is pushed, and at times lets go: every branch is taken."""
    t = np.arange(samples) * PERIOD_S
    velocity = 0.6 * np.sin(4.1 * t) + 0.3 * np.sin(17.3 * t)
    rendered = 5.0 * np.sin(1.7 * t) + 4.0 * np.sin(0.31 * t)
    holds = np.sin(0.9 * t) > -0.3
    return velocity, rendered, np.where(holds, -rendered + 0.8 * np.sin(23.0 * t), 0.01)


def measure(case: Case, inputs: tuple[Array, Array, Array], repeats: int) -> Cost:
    """Compare on some samples, then time; the plain Python peer gets a tenth of them."""
    samples = len(inputs[0])
    few = tuple(signal[: max(samples // 10, 1)] for signal in inputs)
    for peer in (case.numpy, case.python):
        if peer is not None and not np.allclose(case.ours(*few), peer(*few), atol=1e-9):
            sys.exit(f"{case.name}: the peer computes something else")
    works = {"ours": partial(case.ours, *inputs)}
    works |= {} if case.numpy is None else {"numpy": partial(case.numpy, *inputs)}
    works |= {} if case.python is None else {"python": partial(case.python, *few)}
    times = in_turns(works, range(repeats))
    own = times["ours"]
    numpy_ns, python_ns = (
        min(times[peer]) / len(seen[0]) if peer in times else None
        for peer, seen in (("numpy", inputs), ("python", few))
    )
    return Cost(
        name=case.name,
        ns=min(own) / samples,
        ns_median=float(np.median(own)) / samples,
        numpy_ns=numpy_ns,
        python_ns=python_ns,
    )


def main() -> int:
    """Measure, print, and check the requirement."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--samples", 500_000, "of each case")
    add_number(options, "--repeats", 5, "the least time counts")
    arguments = options.parse_args()

    out = table_file(arguments.json)
    inputs = signals(arguments.samples)
    costs = [
        measure(case, inputs, arguments.repeats)
        for case in track(cases(), "safety", console=Console(stderr=True), transient=True)
    ]

    print("ns per sample, one axis; NumPy and Python: time of the peer over ours\n", file=out)
    rows = (
        (cost.name, f"{cost.ns:.1f}", f"{cost.ns_median:.1f}",
         *(ns and f"{ns / cost.ns:.1f}x" for ns in (cost.numpy_ns, cost.python_ns)))
        for cost in costs
    )  # fmt: skip
    print_table(("", "best", "median", "NumPy", "Python"), rows, out)

    million = signals(REQUIRED_SAMPLES)
    both = controlled("hsc", "wsc")
    both_ns = in_turns({"both": lambda: both(*million)}, range(REQUIRED_REPEATS))["both"]
    required = [ns * 1e-9 for ns in both_ns]
    met = min(required) < REQUIRED_S
    print(
        f"\n{REQUIRED_SAMPLES} samples through HSC and WSC: best of {REQUIRED_REPEATS} "
        f"{min(required):.4f} s, median {float(np.median(required)):.4f} s; "
        f"required under {REQUIRED_S} s: {'met' if met else 'MISSED'}",
        file=out,
    )
    write_json(
        arguments.json,
        {
            "samples": arguments.samples,
            "repeats": arguments.repeats,
            "costs": [asdict(cost) for cost in costs],
            "required_s": REQUIRED_S,
            "required_samples": REQUIRED_SAMPLES,
            "hsc_wsc_s": required,
            "met": met,
        },
    )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
