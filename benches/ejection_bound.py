"""How near random scenes come to the bound on ejection speed, and that none exceeds it.

Each scene has a device, loop, limits, thresholds and estimator of its own, drawn at random, and many releases: a hand
that rests against a push lets it go, and the push goes on as steps up to the cap, at random, to and fro, or steady. Of
HSC alone the push does not grow, and there are mechanical stops.
"""

import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from _report import bench_options, table_file, write_json
from haptether.bridge import Scene, sweep
from haptether.bridge.scene.errors import Raw
from haptether.bridge.scene.load import checked
from haptether.safety import ejection_bound

Array = npt.NDArray[np.float64]

PUSHES = 9
"""Steps of the push after the release."""
RELEASE_S = 0.7
"""By then the hand rests."""
GROUPS = {
    "wsc": ("wsc",),
    "hsc": ("hsc",),
    "wsc + hsc": ("wsc", "hsc"),
    "wsc + vfc": ("wsc", "vfc"),
    "wsc + hsc + vfc": ("wsc", "hsc", "vfc"),
    "wsc + pc": ("wsc", "pc"),
}
ESTIMATORS = (
    {"kind": "kalman"},
    {"kind": "kalman", "jerk_density": 1000.0},
    {"kind": "savitzky-golay"},
    {"kind": "low-pass", "cutoff_hz": 60.0},
    {"kind": "backward-difference"},
    {"kind": "dual-kalman"},
)


@dataclass(frozen=True, slots=True)
class Tightness:
    """How near a group of scenes came to its bound."""

    controllers: str
    velocity: str
    """Measured by the device, or estimated."""
    scenes: int
    rows: int
    exceeded: int
    worst: float
    """Largest speed seen over the bound."""
    median: float
    """Of the largest of each scene."""
    seed: int
    """Of the worst scene."""


def random_scene(rng: np.random.Generator, controllers: tuple[str, ...], *, measured: bool) -> Scene:
    """A device that is pushed, without an arm, and a hand that lets it go."""
    mass_kg, cap_n = rng.uniform(0.05, 0.5), rng.uniform(2.0, 8.0)
    travel_m = rng.uniform(0.05, 0.3)
    estimator = ESTIMATORS[rng.integers(len(ESTIMATORS))]
    quantum_m = 0.0 if measured else float(rng.choice([1e-5, 2.3e-5, 5e-5]))
    master: dict[str, Raw] = {
        "mass_kg": mass_kg,
        "viscous": rng.uniform(-0.005, 0.3) * rng.integers(2),
        "coulomb": rng.uniform(0.0, 0.1) * rng.integers(2),
        "encoder_quantum": quantum_m,
        "measures_velocity": measured,
        "max_force_n": cap_n,
    }
    if controllers == ("hsc",):
        master["stops"] = [-0.02, travel_m - 0.02]
    safety = {
        "controllers": list(controllers),
        "estimator": estimator,
        "damping": min(5.0, mass_kg / 5e-3),
        "energy_threshold_j": -rng.uniform(0.005, 0.06),
        "energy_ratio": rng.uniform(0.3, 1.0),
        "window": int(rng.integers(20, 300)),
        "hsc_force_threshold_n": rng.uniform(0.1, 2.0),
        "hold_off_s": float(rng.choice([0.0, 0.1])),
        "release_ramp_s": float(rng.choice([0.0, 0.2])),
        "probe_force_n": 0.0,
        "release_tries": 0,
        "hsc_velocity_threshold": 0.0,
        "velocity_threshold": rng.uniform(0.2, 1.0),
        "vfc_force_threshold_n": rng.uniform(0.3, 3.0),
        "limiter": {"ramp_in_s": 0.0, "max_slew_n_per_s": float(rng.choice([500.0, 1000.0, 4000.0, 1e6]))},
    }
    push = {"shape": "step", "force_n": 0.0}
    raw = {
        "schema": 1,
        "run": {"duration_s": RELEASE_S + 0.3},
        "master": master,
        "operator": {
            "stiffness": 3000.0,
            "damping": 2.0 * np.sqrt(3000.0 * mass_kg),
            "grip_strength_n": 100.0,
            "release": {"at_s": RELEASE_S, "decay_s": 0.0},
        },
        "environment": {"pushers": [push] * (PUSHES + 1)},
        "safety": safety,
    }
    plain = checked(_plain(raw), Path())
    return plain.scene


def _plain(raw: Any) -> Raw:  # noqa: ANN401  # numbers of either kind, at any depth
    """Numbers of NumPy as Python's own, which the schema knows."""
    if isinstance(raw, dict):
        return {key: _plain(value) for key, value in raw.items()}
    if isinstance(raw, list):
        return [_plain(value) for value in raw]
    plain: Raw = raw.item() if isinstance(raw, np.generic) else raw
    return plain


def random_pushes(rng: np.random.Generator, scene: Scene, rows: int) -> dict[str, Array]:
    """A push that is held, and what it becomes after the release, a row each."""
    cap_n = scene.master.max_force_n
    assert isinstance(cap_n, float)
    held = cap_n * rng.uniform(0.1, 1.0, rows)
    first = rng.choice([0.0, 1.0], (rows, 1)) * rng.uniform(0.0, 0.03, (rows, 1))
    gaps = rng.uniform(0.001, rng.choice([0.006, 0.012, 0.03], (rows, 1)), (rows, PUSHES - 1))
    times = RELEASE_S + 5e-4 + np.cumsum(np.concatenate((first, gaps), axis=1), axis=1)
    if scene.safety.controllers == ("hsc",):
        levels = held[:, None] * np.cumprod(
            rng.uniform(0.3, 1.0, (rows, PUSHES)) ** rng.integers(0, 2, (rows, 1)), axis=1
        )
    else:
        kind = rng.integers(4, size=(rows, 1))
        levels = rng.uniform(-cap_n, cap_n, (rows, PUSHES))
        levels = np.where(kind == 1, cap_n * np.sign(levels), levels)
        to_and_fro = cap_n * np.where(np.arange(PUSHES) % 2 == 0, 1.0, -1.0) * rng.choice([-1.0, 1.0], (rows, 1))
        levels = np.where(kind == 2, to_and_fro, levels)
        levels = np.where(kind == 3, held[:, None] * np.ones(PUSHES), levels)
    steps = np.diff(np.concatenate((held[:, None], levels), axis=1), axis=1)
    pushers = "environment.pushers"
    samples = {f"{pushers}.0.force_n": held}
    for place in range(PUSHES):
        samples[f"{pushers}.{place + 1}.force_n"] = np.ascontiguousarray(steps[:, place])
        samples[f"{pushers}.{place + 1}.at_s"] = np.ascontiguousarray(times[:, place])
    return samples


def ratios(seed: int, controllers: tuple[str, ...], *, measured: bool, rows: int, threads: int = 1) -> Array:
    """Largest speed after the release over the bound, of each row of one random scene."""
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, controllers, measured=measured)
    bound = ejection_bound(scene).speed
    assert bound is not None
    seen = sweep(scene, samples=random_pushes(rng, scene, rows), threads=threads)
    assert set(seen["outcome"]) == {"complete"}
    return np.asarray(seen["max_ejection_velocity"] / bound)


def main() -> int:
    """Runs all groups; 1 if a scene exceeds its bound, or the bound of WSC and its unions is not near."""
    options = bench_options(__doc__, "Status 1 says that a scene exceeds its bound, or that a bound is not near.")
    options.add_argument("--rows", type=int, default=100_000, help="scenes in all (100000)")
    options.add_argument("--each", type=int, default=400, help="releases of each device (400)")
    options.add_argument("--threads", type=int, default=2, help="threads (2)")
    options.add_argument("--seed", type=int, default=0, help="of the first scene (0)")
    arguments = options.parse_args()
    begun = time.perf_counter()
    table, found = table_file(arguments.json), []
    each = arguments.each
    print("controllers       V          scenes    rows  above  largest  median  seed", file=table)
    for name, controllers in GROUPS.items():
        for measured in (True, False):
            scenes = max(1, round(arguments.rows / each / len(GROUPS) / 2))
            worst = {
                seed: ratios(seed, controllers, measured=measured, rows=each, threads=arguments.threads)
                for seed in range(arguments.seed, arguments.seed + scenes)
            }
            largest = {seed: float(of.max()) for seed, of in worst.items()}
            seed = max(largest, key=lambda one: largest[one])
            group = Tightness(
                controllers=name,
                velocity="measured" if measured else "estimated",
                scenes=scenes,
                rows=scenes * each,
                exceeded=sum(int((of > 1.0).sum()) for of in worst.values()),
                worst=largest[seed],
                median=float(np.median(list(largest.values()))),
                seed=seed,
            )
            found.append(group)
            print(
                f"{name:16}  {group.velocity:9}  {scenes:6}  {group.rows:6}  {group.exceeded:5}"
                f"  {group.worst:7.3f}  {group.median:6.3f}  {seed:4}",
                file=table,
                flush=True,
            )
    took = time.perf_counter() - begun
    rows = sum(group.rows for group in found)
    print(f"{rows} releases in {took:.0f} s", file=table)
    write_json(arguments.json, {"seconds": took, "groups": [asdict(group) for group in found]})
    near = all(group.worst >= 0.8 for group in found if "wsc" in group.controllers)
    return 0 if near and not any(group.exceeded for group in found) else 1


if __name__ == "__main__":
    sys.exit(main())
