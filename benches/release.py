"""Motion of a released stylus under a lasting push, by the law that ends an intervention.

A hand holds the stylus against a push, lets go within 20 ms, and does not come back. The push goes on for 10 s. Three
laws end an intervention:

- printed: as the paper prints it, the force is back as soon as no controller trips,
- by time: hold-off 0.1 s, a ramp of 0.2 s,
- default: a probe that a hand must answer. Where friction hides the probe (kind "omni"), a hand must move the device.

Measured from the release on:

- MEV: the greatest speed of the first 0.3 s,
- later: the greatest speed after that, beside how often it rose above 0.15 m/s,
- way: the largest displacement from where the stylus was 0.3 s after the release,
- trips each second,
- the RMS of the device force above 30 Hz after those 0.3 s; all below is removed from its spectrum. This leaves out the
  one step down at the first trip, which every law has.

Ends with status 1 if under the default law a stylus

- moves more than 20 mm,
- is thrown twice,
- is faster than 0.1 m/s later,
- rattles more than a tenth as much as under the printed law, or
- is thrown more than 5 % faster than there and also faster than the probe itself moves a device.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import msgspec
import numpy as np

from _report import bench_options, print_table, table_file, write_json
from haptether.bridge import TRIP_BITS, Scene, simulate

EXAMPLE = """example:
  .venv/bin/python benches/release.py --json -
"""
RELEASE_S = 1.0
PUSHED_S = 10.0
FIRST_S = 0.3
"""Time by which the first throw is over."""
THROWN = 0.15
"""Speed in m/s above which a stylus counts as thrown."""
PROBED = 0.1
"""Speed in m/s that the default probe does not reach."""
RATTLE_HZ = 30.0
LAWS: dict[str, dict[str, float]] = {
    "printed": {"hold_off_s": 0.0, "release_ramp_s": 0.0, "probe_force_n": 0.0, "release_tries": 0},
    "by time": {"hold_off_s": 0.1, "release_ramp_s": 0.2, "probe_force_n": 0.0, "release_tries": 0},
    "default": {},
}
KINDS = ("1 axis", "3 axes", "pose", "omni")
CONTROLLERS = (("wsc",), ("hsc",), ("vfc",), ("wsc", "hsc"), ("vfc", "hsc", "wsc"))
PUSHES_N = (3.0, 7.0)
PUSHES_OF_OMNI_N = (2.0, 3.0)
"""An Omni exerts 3.3 N."""
DIRECTION = (0.8, -0.48, 0.36)
HELD = TRIP_BITS["held"]
"""Bit of `tripped` that marks the rest of an earlier trip."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One push, one law."""

    kind: str
    controllers: str
    push_n: float
    law: str
    mev: float
    later: float
    thrown: int
    way_m: float
    trips_per_s: float
    rattle_n: float


def scene(kind: str, controllers: tuple[str, ...], push_n: float, law: dict[str, float]) -> Scene:
    """Return a scene with a hand that lets go under a push of `push_n` in N."""
    axes = 1 if kind in {"1 axis", "omni"} else 3
    force = push_n if axes == 1 else [push_n * share for share in DIRECTION]
    tables: dict[str, Any] = {
        "schema": 1,
        "run": {"duration_s": RELEASE_S + PUSHED_S},
        "master": {"device": "phantom-omni" if kind == "omni" else "phantom-desktop", "axes": axes},
        "operator": {
            "stiffness": 3000.0,
            "damping": 60.0,
            "release": {"at_s": RELEASE_S, "decay_s": 0.02, "kind": "gain"},
        },
        "environment": {"pushers": [{"shape": "ramp", "at_s": 0.1, "rise_s": 0.6, "force_n": force}]},
        # Below 1 N the encoder's quantum dominates S_h.
        "safety": {"controllers": controllers, "hsc_force_threshold_n": 1.0, **law},
        "record": {},
    }
    if kind == "pose":
        inertia = [4e-4] * 3
        tables["master"] = {
            "kind": "pose",
            "axes": 3,
            "mass_kg": 0.157,
            "coulomb": 0.038,
            "rotation": {"inertia_kg_m2": inertia, "coulomb": 1e-3, "max_torque_n_m": 0.5},
        }
        tables["operator"] |= {
            "clutch": "once",
            "rotation": {
                "stiffness": 3.0,
                "damping": 0.03,
                "release": {"at_s": RELEASE_S, "decay_s": 0.02, "kind": "gain"},
            },
        }
        tables["slave"] = {
            "control": "pd",
            "mass_kg": 2.0,
            "stiffness": 2000.0,
            "tool": {"inertia_kg_m2": [0.02] * 3, "rotational_stiffness": 50.0},
        }
        tables["coupling"] = {"force_scale": 1.0}
    return msgspec.convert(tables, Scene)


def measured(kind: str, controllers: tuple[str, ...], push_n: float, law: str) -> Row:
    """Run one case."""
    signals = simulate(scene(kind, controllers, push_n, LAWS[law])).signals
    assert signals is not None
    time_s = np.asarray(signals["time_s"])
    period_s = float(time_s[1] - time_s[0])
    after = time_s >= RELEASE_S

    def vectors(name: str) -> np.ndarray:
        return np.asarray(signals[name]).reshape(len(time_s), -1)[after]

    speed, position = np.linalg.norm(vectors("velocity"), axis=1), vectors("position")
    first = round(FIRST_S / period_s)
    later = speed[first:]
    thrown = np.count_nonzero((speed[1:] > THROWN) & (speed[:-1] <= THROWN))
    is_trip = (np.asarray(signals["tripped"])[after].astype(int) & ~HELD) != 0
    lasting_n = vectors("device_force")[first:]
    spectrum = np.fft.rfft(lasting_n, axis=0)
    frequency_hz = np.fft.rfftfreq(len(lasting_n), period_s)
    spectrum[frequency_hz < RATTLE_HZ] = 0.0
    rattle = np.fft.irfft(spectrum, len(lasting_n), axis=0)
    return Row(
        kind=kind,
        controllers="+".join(controllers),
        push_n=push_n,
        law=law,
        mev=float(speed[:first].max()),
        later=float(later.max()),
        thrown=int(thrown),
        way_m=float(np.linalg.norm(position[first:] - position[first], axis=1).max()),
        trips_per_s=float(np.count_nonzero(is_trip[1:] & ~is_trip[:-1])) / PUSHED_S,
        rattle_n=float(np.sqrt((rattle**2).sum(axis=1).mean())),
    )


def rows(kinds: Sequence[str]) -> Iterator[Row]:
    """Yield all rows of the table."""
    for kind in kinds:
        for controllers in CONTROLLERS:
            for push_n in PUSHES_OF_OMNI_N if kind == "omni" else PUSHES_N:
                for law in LAWS:
                    yield measured(kind, controllers, push_n, law)


def failures(found: list[Row]) -> Iterator[str]:
    """Yield the cases in which the default misses its requirements."""
    printed = {(row.kind, row.controllers, row.push_n): row for row in found if row.law == "printed"}
    for row in found:
        if row.law != "default":
            continue
        before = printed[row.kind, row.controllers, row.push_n]
        name = f"{row.kind}, {row.controllers}, {row.push_n:g} N"
        if row.way_m > 0.02:
            yield f"{name}: goes {1e3 * row.way_m:.0f} mm"
        if row.thrown > 1:
            yield f"{name}: thrown {row.thrown} times"
        if row.later > PROBED:
            yield f"{name}: {row.later:.3f} m/s later"
        if before.trips_per_s > 1.0 and row.rattle_n > before.rattle_n / 10.0:
            yield f"{name}: rattles with {row.rattle_n:.3f} N after {before.rattle_n:.3f} N"
        if row.mev > max(1.05 * before.mev, PROBED):
            yield f"{name}: MEV {row.mev:.3f} after {before.mev:.3f} m/s"


def main() -> None:
    """Run, print, and check the requirements of the default."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--kind", action="append", choices=KINDS, help="by default all")
    arguments = options.parse_args()
    found = list(rows(arguments.kind or KINDS))
    out = table_file(arguments.json)
    print_table(
        ("kind", "controllers", "push", "law", "MEV", "later", "thrown", "way", "trips/s", "> 30 Hz"),
        (
            (row.kind, row.controllers, f"{row.push_n:g} N", row.law, f"{row.mev:.3f} m/s", f"{row.later:.3f} m/s",
             row.thrown, f"{1e3 * row.way_m:.0f} mm", f"{row.trips_per_s:.1f}", f"{row.rattle_n:.3f} N")
            for row in found
        ),
        out,
    )  # fmt: skip
    failed = list(failures(found))
    for failure in failed:
        print(failure, file=out)
    write_json(arguments.json, {"rows": [asdict(row) for row in found], "failed": failed})
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
