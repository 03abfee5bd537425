"""Couplings by pair of devices and round trip: felt force, lag of the arm, swing, and the thrown device.

A hand presses a wall through an arm, holds, and lets go; no controller acts. Each coupling has the gains that `check`
advises for the pair and delay (`pd-damped`, `wave`), or its own. All runs are in virtual time.
"""

import sys
from typing import Any

import msgspec
import numpy as np

from _report import bench_options, print_table, table_file, write_json
from haptether.bridge import COUPLINGS, Scene, SceneError, override_scene, simulate
from haptether.studies.design.couplings import advised_coupling, advised_waves

EXAMPLE = "example: python benches/coupling_choice.py --round-trip-ms 40 200 --network rough --json -"
ROUND_TRIPS_MS = (5, 40, 100, 200, 500)
NETWORKS = ("steady", "rough")
RELEASE_S, LAST_S = 8.0, 0.5
RUN = {"duration_s": 10.0}
PAIRS: dict[str, dict[str, Any]] = {
    "desktop device, UR": {
        "schema": 1,
        "run": RUN,
        "master": {"device": "phantom-desktop", "stops": [[-0.08, 0.08]]},
        "operator": {
            "stiffness": 300.0, "damping": 8.0, "grip_strength_n": 12.0, "start": 0.02, "clutch": "once",
            "legs": [{"duration_s": 1.0, "end": -0.02}], "release": {"at_s": RELEASE_S, "decay_s": 0.05},
        },
        "slave": {"position": 0.02},
        "environment": {"objects": [{"shape": {"kind": "plane"}, "contact": {"stiffness": 2000.0}}]},
        "record": {},
    },
    "Dynamixel leader, follower": {
        "schema": 1,
        "run": RUN,
        "master": {"kind": "joints", "mass_kg": 0.01, "viscous": 0.05, "stops": [[-1.5, 1.5]]},
        "operator": {
            "stiffness": 5.0, "damping": 0.3, "grip_strength_n": 50.0, "start": 0.5, "clutch": "once",
            "legs": [{"duration_s": 1.0, "end": -0.3}], "release": {"at_s": RELEASE_S, "decay_s": 0.05},
        },
        "slave": {"position": 0.5, "bandwidth_hz": 20.0},
        "environment": {"objects": [{"shape": {"kind": "plane"}, "contact": {"stiffness": 20.0}}]},
        "record": {},
    },
}  # fmt: skip


def pair_scene(pair: str, round_trip_ms: float, network: str) -> Scene:
    """Return the scene of a pair over a network, without controllers."""
    delay_s = round_trip_ms * 5e-4
    link = {"delay_s": delay_s}
    if network == "rough":
        link |= {"jitter_s": min(0.005, 0.4 * delay_s), "loss": 0.01}
    tables = {**PAIRS[pair], "link": {"forward": link, "backward": link}, "safety": {"controllers": []}}
    return msgspec.convert(tables, Scene)


def advised(scene: Scene, kind: str) -> list[str] | None:
    """Return the overrides for a coupling with advised gains; None if none is advised."""
    changes = [f"coupling.kind={kind}"]
    if kind == "pd-damped":
        found = advised_coupling(scene, 1.0, (kind,))
        return None if found is None else list(found.changes)
    if kind == "wave" and (waves := advised_waves(scene)) is not None:
        return [*changes, f"coupling.impedance={waves[0]:g}"]
    if kind == "position-force":
        return changes
    is_joints = scene.master.kind == "joints"
    if is_joints:
        # The defaults are for m; a joint bears about 1/30 of K and 1/60 of B.
        changes += {
            "pspm": ["coupling.stiffness=10", "coupling.damping=0.3"],
            "wave": ["coupling.stiffness=30", "coupling.damping=0.5", "coupling.impedance=0.5"],
            "tdpa": ["coupling.stiffness=10", "coupling.damping=0.2", "coupling.impedance=0.1"],
        }.get(kind, ["coupling.stiffness=10", "coupling.damping=0.2"])
    elif kind == "pspm":
        changes += ["coupling.stiffness=300", "coupling.damping=3"]
    return changes


def measured(pair: str, kind: str, round_trip_ms: float, network: str) -> dict[str, Any] | None:
    """Return the figures of a run, or None if the pair does not bear the coupling."""
    scene = pair_scene(pair, round_trip_ms, network)
    changes = advised(scene, kind)
    if changes is None:
        return None
    try:
        run = simulate(override_scene(scene, changes))
    except SceneError:
        return None
    signals = run.signals
    assert signals is not None
    time_s = np.asarray(signals.time_s)
    begun = time_s[np.isin(signals.state, [2, 3])][0]
    held = (time_s >= begun + RELEASE_S - LAST_S) & (time_s < begun + RELEASE_S)
    force, hand, arm = (np.ravel(getattr(signals, name)) for name in ("rendered_force", "position", "slave_position"))
    operator, wall = scene.operator, PAIRS[pair]["environment"]["objects"][0]["contact"]["stiffness"]
    assert operator is not None
    target = PAIRS[pair]["operator"]["legs"][0]["end"]
    rigid = abs(target) / (1.0 / PAIRS[pair]["operator"]["stiffness"] + 1.0 / wall)
    return {
        "pair": pair, "kind": kind, "round_trip_ms": round_trip_ms, "network": network, "changes": changes[1:],
        "felt": float(abs(force[held].mean()) / rigid),
        "behind": float(abs(np.mean(hand[held] - arm[held]))),
        "swing": float(np.ptp(force[held])),
        "thrown": run.metrics.max_ejection_velocity,
        "outcome": run.metrics.outcome,
    }  # fmt: skip


def main() -> int:
    """Measure and print the table."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--round-trip-ms", type=float, nargs="+", default=ROUND_TRIPS_MS, help="default %(default)s")
    options.add_argument("--network", choices=NETWORKS, default="rough", help="default %(default)s")
    chosen = options.parse_args()
    rows = []
    for pair in PAIRS:
        for round_trip_ms in chosen.round_trip_ms:
            for kind, *_ in COUPLINGS:
                row = measured(pair, kind, round_trip_ms, chosen.network)
                rows.append(row or {"pair": pair, "kind": kind, "round_trip_ms": round_trip_ms})
    heads = ("pair", "ms", "coupling", "felt", "arm behind", "swing", "thrown", "gains")
    names = ("felt", "behind", "swing", "thrown")
    shown = (
        (
            row["pair"], f"{row['round_trip_ms']:g}", row["kind"],
            *(None if row.get(name) is None else f"{row[name]:.3g}" for name in names),
            " ".join(change.removeprefix("coupling.") for change in row.get("changes", [])),
        )
        for row in rows
    )  # fmt: skip
    print_table(heads, shown, table_file(chosen.json))
    write_json(chosen.json, {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
