"""Time per scenario-tick of a sweep, against its bare kernel, Numba, NumPy and plain Python in the same run.

The scene is benches/work_unit.toml: hand, device, wall and WSC on one axis, 2000 ticks, swept over the depth of the
press. Every implementation has to reproduce the sum of the peaks to nine digits and the ticks under intervention
exactly. Ours is `haptether.sweep` as anybody calls it, for the two metrics of these sums or for all: reading the scene
and building every scenario are in the time.

The bare kernel, benches/bare_kernel.cpp, is the same work and nothing around it, compiled for this machine by `c++`
where there is one: 8 and 16 scenarios side by side; a sweep has 16 where the processor has AVX-512, else 8. The
requirement: a sweep takes at most twice as long as the kernel of its width.
"""

import ctypes
import importlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

import haptether
from _report import bench_options, table_file, write_json
from haptether.bridge import load_scene

Array = npt.NDArray[np.float64]
Sums = tuple[float, int]
"""Sum of the peaks in m/s, and of the ticks under intervention."""

EXAMPLE = "example: python benches/batch.py --json - --repeats 9"
SCENE = Path(__file__).with_name("work_unit.toml")
TICKS = 2000
REQUIRED_RATIO = 2.0
"""Of a sweep's time to that of the bare kernel."""
KERNEL = Path(__file__).with_name("bare_kernel.cpp")
WIDTHS = (8, 16)
WIDE_NEEDS = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
"""What a processor has for which a sweep has 16 scenarios side by side."""
COMPARED = ("max_ejection_velocity", "intervention_ticks")
"""The metrics of these sums."""
EXPECTED: dict[int, Sums] = {
    1: (0.329684270, 50),
    100: (34.971638466, 2459),
    10_000: (3500.394342658, 245_235),
}
M, B, C, K_WALL, K_HAND, B_HAND = 0.157, -0.005, 0.038, 200.0, 300.0, 5.0
MU, ETA, DELTA, WINDOW, DT = 5.0, 0.5, -0.03, 100, 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Least time of one implementation over N scenarios."""

    name: str
    scenarios: int
    ns_per_scenario_tick: float
    median_ns: float
    agrees: bool


def depths(scenarios: int) -> Array:
    """Depth of the press in m for each of the scenarios."""
    return np.array([0.05]) if scenarios == 1 else 0.01 + 0.05 * np.arange(scenarios) / (scenarios - 1)


def ours(threads: int, lanes: bool, metrics: tuple[str, ...] | None = COMPARED) -> Callable[[Array], Sums]:
    """`haptether.sweep` on so many threads, of some metrics or of all."""
    scene = load_scene(SCENE)

    def run(depth: Array) -> Sums:
        samples = {"operator.legs.0.end": -depth}
        swept = haptether.sweep(scene, samples=samples, threads=threads, lanes=lanes, metrics=metrics)
        ticks = swept["intervention_ticks"]
        return float(swept["max_ejection_velocity"].sum()), int(ticks.sum())

    return run


def scalar_loop(depth: float) -> tuple[float, int]:
    """One scenario in plain Python; Numba compiles this very function."""
    z, v, s, peak, on = 0.02, 0.0, 0.0, 0.0, 0
    ring = np.zeros(WINDOW)
    for k in range(TICKS):
        t = k * DT
        g = min(max(1.0 - (t - 1.0) / 0.05, 0.0), 1.0)
        r = min(2.0 * t, 1.0)
        target = 0.02 + (-depth - 0.02) * r * r * (3.0 - 2.0 * r)
        hand = g * (K_HAND * (target - z) - B_HAND * v)
        wall = -K_WALL * z if z < 0.0 else 0.0
        power = hand * v
        s += power - ring[k % WINDOW]
        ring[k % WINDOW] = power
        energy = DT * s - M * v * v / (2.0 * ETA)
        control = 0.0
        if energy < DELTA:
            control = -wall - MU * v
            on += 1
        friction = C * min(max(v / 1e-3, -1.0), 1.0)
        v += DT * (hand + wall + control - B * v - friction) / M
        z += DT * v
        if t >= 1.0 and v > peak:
            peak = v
    return peak, on


def plain_python(depth: Array) -> Sums:
    """All scenarios, one after the other."""
    results = [scalar_loop(float(d)) for d in depth]
    return sum(peak for peak, _ in results), sum(on for _, on in results)


def over_scenarios(depth: Array) -> Sums:
    """All scenarios at once as arrays."""
    n = len(depth)
    z, v, s, peak = np.full(n, 0.02), np.zeros(n), np.zeros(n), np.zeros(n)
    ring, on = np.zeros((WINDOW, n)), 0
    for k in range(TICKS):
        t = k * DT
        g = min(max(1.0 - (t - 1.0) / 0.05, 0.0), 1.0)
        r = min(2.0 * t, 1.0)
        target = 0.02 + (-depth - 0.02) * r * r * (3.0 - 2.0 * r)
        hand = g * (K_HAND * (target - z) - B_HAND * v)
        wall = np.where(z < 0.0, -K_WALL * z, 0.0)
        power = hand * v
        s += power - ring[k % WINDOW]
        ring[k % WINDOW] = power
        trips = DT * s - M * v * v / (2.0 * ETA) < DELTA
        on += int(np.count_nonzero(trips))
        control = np.where(trips, -wall - MU * v, 0.0)
        friction = C * np.clip(v / 1e-3, -1.0, 1.0)
        v = v + DT * (hand + wall + control - B * v - friction) / M
        z = z + DT * v
        if t >= 1.0:
            peak = np.maximum(peak, v)
    return float(peak.sum()), on


def compiled(parallel: bool) -> Callable[[Array], Sums] | None:
    """The scalar loop through Numba, on one thread or on all; none where Numba is not installed."""
    try:
        numba: Any = importlib.import_module("numba")
    except ImportError:
        return None
    one = numba.njit(scalar_loop)
    indices = numba.prange if parallel else range

    def each(depth: Array, peaks: Array, ons: npt.NDArray[np.int64]) -> None:
        for i in indices(len(depth)):
            peaks[i], ons[i] = one(depth[i])

    loop = numba.njit(each, parallel=parallel)

    def run(depth: Array) -> Sums:
        peaks, ons = np.empty(len(depth)), np.empty(len(depth), np.int64)
        loop(depth, peaks, ons)
        return float(peaks.sum()), int(ons.sum())

    return run


def sweep_width() -> int:
    """How many scenarios a sweep has side by side on this processor (`bridge/src/scene/sweep/stepped.rs`)."""
    described = Path("/proc/cpuinfo")
    text = described.read_text(encoding="utf-8") if described.exists() else ""
    flags = next((line.split() for line in text.splitlines() if line.startswith("flags")), [])
    return WIDTHS[1] if set(flags) >= WIDE_NEEDS else WIDTHS[0]


def bare_kernel(width: int, folder: Path) -> Callable[[Array], Sums] | None:
    """The kernel for so many scenarios side by side, built in `folder`; none without a compiler that has vectors."""
    compiler = shutil.which(os.environ.get("CXX", "c++"))
    if compiler is None:
        return None
    # As wide as the processor's registers: eight numbers with AVX-512, four with AVX2, two with SSE2.
    probe = [compiler, "-march=native", "-dM", "-E", "-x", "c++", os.devnull]
    probed = subprocess.run(probe, capture_output=True, text=True, check=False)
    vector = 8 if "__AVX512F__" in probed.stdout else 4 if "__AVX2__" in probed.stdout else 2
    library = folder / f"bare_kernel_{width}.so"
    options = ["-O3", "-march=native", "-ffp-contract=off", "-Wno-psabi", "-shared", "-fPIC"]
    defines = [f"-DVECTOR={vector}", f"-DBLOCKS={width // vector}"]
    command = [compiler, *options, *defines, str(KERNEL), "-o", str(library)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        return None
    kernel = ctypes.CDLL(str(library)).bare_kernel
    kernel.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_void_p]
    kernel.restype = None

    def run(depth: Array) -> Sums:
        rows = -(-len(depth) // width) * width
        padded = np.full(rows, depth[-1])
        padded[: len(depth)] = depth
        peaks, ons = np.empty(rows), np.empty(rows, np.int64)
        kernel(padded.ctypes.data, rows, TICKS, peaks.ctypes.data, ons.ctypes.data)
        return float(peaks[: len(depth)].sum()), int(ons[: len(depth)].sum())

    return run


def implementations(folder: Path) -> dict[str, tuple[Callable[[Array], Sums], int]]:
    """Each with the most scenarios that it is given; `folder` is for what is compiled."""
    found: dict[str, tuple[Callable[[Array], Sums], int]] = {
        "haptether, lanes, 1 thread": (ours(1, True), 10_000),
        "haptether, lanes, all metrics, 1 thread": (ours(1, True, None), 10_000),
        "haptether, lanes, 2 threads": (ours(2, True), 10_000),
        "haptether, no lanes, 1 thread": (ours(1, False), 10_000),
        "NumPy over scenarios": (over_scenarios, 10_000),
        "plain Python": (plain_python, 1),
    }
    for width in WIDTHS:
        if (kernel := bare_kernel(width, folder)) is not None:
            found[f"bare kernel, {width} side by side"] = (kernel, 10_000)
    for name, parallel in (("Numba, 1 thread", False), ("Numba, all threads", True)):
        if (run := compiled(parallel)) is not None:
            found[name] = (run, 10_000)
    return found


def measure(runs: dict[str, Callable[[Array], Sums]], scenarios: int, repeats: int) -> list[Cost]:
    """Times implementations in turns, as a shared machine is quicker in one minute than in the next.

    The first call of each, which may compile, is not counted.
    """
    depth = depths(scenarios)
    expected_peaks, expected_on = EXPECTED[scenarios]
    sums = {name: run(depth) for name, run in runs.items()}
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            begun = time.perf_counter()
            run(depth)
            times[name].append((time.perf_counter() - begun) * 1e9 / (scenarios * TICKS))
    return [
        Cost(
            name=name,
            scenarios=scenarios,
            ns_per_scenario_tick=min(times[name]),
            median_ns=float(np.median(times[name])),
            agrees=abs(peaks - expected_peaks) < 1e-9 * max(1.0, expected_peaks) and on == expected_on,
        )
        for name, (peaks, on) in sums.items()
    ]


def main() -> int:
    """Prints the table; 1 if an implementation disagrees, or ours is slower than required."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--repeats", type=int, default=5, help="times that each is timed (default 5)")
    arguments = options.parse_args()
    console = Console(file=table_file(arguments.json))
    costs: list[Cost] = []
    with console.status("timing"), tempfile.TemporaryDirectory() as folder:
        found = implementations(Path(folder))
        for scenarios in EXPECTED:
            runs = {name: run for name, (run, most) in found.items() if scenarios <= most}
            costs += measure(runs, scenarios, arguments.repeats * (20 if scenarios < 1000 else 1))
        costs.sort(key=lambda cost: list(found).index(cost.name))
    numba = {cost.scenarios: cost.ns_per_scenario_tick for cost in costs if cost.name == "Numba, 1 thread"}
    table = Table("", "scenarios", "ns per scenario-tick", "median", "Numba / it", "same sums")
    for cost in costs:
        ratio = f"{numba[cost.scenarios] / cost.ns_per_scenario_tick:.2f}" if numba else ""
        fastest, median = f"{cost.ns_per_scenario_tick:.2f}", f"{cost.median_ns:.2f}"
        table.add_row(cost.name, str(cost.scenarios), fastest, median, ratio, "yes" if cost.agrees else "NO")
    console.print(table)
    if not numba:
        console.print("Numba is not installed: `make bench` installs it (tools/bench.txt)")
    best, every = (
        min(cost.ns_per_scenario_tick for cost in costs if cost.name == f"haptether, lanes, {which}1 thread")
        for which in ("", "all metrics, ")
    )
    width = sweep_width()
    kernel = f"bare kernel, {width} side by side"
    bare = min((cost.ns_per_scenario_tick for cost in costs if cost.name == kernel), default=None)
    over, over_every = (None, None) if bare is None else (best / bare, every / bare)
    compared = "no C++ compiler, so no bare kernel"
    if bare is not None:
        compared = f"{kernel} {bare:.2f} ns, ratio {over:.2f}, of all metrics {over_every:.2f}"
    console.print(f"best of ours on one thread, of two metrics: {best:.2f} ns; {compared}; required {REQUIRED_RATIO}")
    console.print(f"{os.cpu_count()} processors")
    report = {
        "required_ratio": REQUIRED_RATIO, "metrics": COMPARED, "best_ns": best, "bare_ns": bare, "ratio": over,
        "all_metrics_ns": every, "all_metrics_ratio": over_every,
    }  # fmt: skip
    write_json(arguments.json, report | {"costs": [asdict(cost) for cost in costs]})
    return 0 if over is not None and over <= REQUIRED_RATIO and all(cost.agrees for cost in costs) else 1


if __name__ == "__main__":
    sys.exit(main())
