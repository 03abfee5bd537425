"""Cost of both halves of each coupling: a tick of a remote scene in virtual time, against position-force.

The peer is `position-force`, which has no halves, in the same scene: joints that a hand leads against a wall, WSC, and
a network of delay, jitter and loss. The time of a tick is that of a long run less that of a short run, divided by the
ticks between them, least of the repeats, on one thread. All couplings take turns, so that other loads affect all.
"""

import sys
from functools import partial
from typing import Any

import msgspec

from _report import add_number, bench_options, in_turns, print_table, table_file, write_json
from haptether.bridge import COUPLINGS, Scene, simulate

EXAMPLE = "example: python benches/coupling_halves.py --axes 1 6 --repeats 20 --json -"
AXES = (1, 3, 6)
SHORT_S, LONG_S = 2.0, 12.0
PEER = "position-force"
NETWORK = {"delay_s": 0.05, "jitter_s": 0.005, "loss": 0.01}


def joints(axes: int, kind: str, duration_s: float) -> Scene:
    """Return a scene of so many joints without signals, in contact from 0.4 s on."""
    rest = [0.0] * (axes - 1)
    tables: dict[str, Any] = {
        "schema": 1,
        "run": {"duration_s": duration_s},
        "master": {"kind": "joints", "axes": axes, "mass_kg": [0.01] * axes, "viscous": [0.05] * axes},
        "operator": {
            "stiffness": 5.0, "damping": 0.3, "start": [0.0] * axes, "clutch": "once",
            "legs": [{"duration_s": 1.0, "end": [0.3] * axes}],
        },
        "slave": {},
        "environment": {"objects": [{
            "shape": {"kind": "plane", "normal": [-1.0, *rest], "point": [0.1, *rest]},
            "contact": {"stiffness": 5.0, "damping": 0.1},
        }]},
        "coupling": {"kind": kind},
        "link": {"forward": NETWORK, "backward": NETWORK},
        "safety": {"controllers": ["wsc"]},
    }  # fmt: skip
    return msgspec.convert(tables, Scene)


def measured(axes: int, repeats: int) -> list[dict[str, Any]]:
    """Return the time of a tick of each coupling, and its difference and ratio to that of position-force."""
    kinds = [kind for kind, *_ in COUPLINGS]
    scenes = {(kind, lasts_s): joints(axes, kind, lasts_s) for kind in kinds for lasts_s in (SHORT_S, LONG_S)}
    works = {f"{kind} {lasts_s}": partial(simulate, scene) for (kind, lasts_s), scene in scenes.items()}
    least = {name: min(times) for name, times in in_turns(works, range(repeats)).items()}
    ticks = {place: simulate(scene).metrics.ticks for place, scene in scenes.items()}
    ns = {
        kind: (least[f"{kind} {LONG_S}"] - least[f"{kind} {SHORT_S}"]) / (ticks[kind, LONG_S] - ticks[kind, SHORT_S])
        for kind in kinds
    }
    more = {kind: {"halves_ns": ns[kind] - ns[PEER], "ratio": ns[kind] / ns[PEER]} for kind in kinds}
    return [{"axes": axes, "kind": kind, "ns": ns[kind], **more[kind]} for kind in kinds]


def main() -> int:
    """Measure and print the table."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--axes", type=int, nargs="+", choices=range(1, 8), default=AXES, help="default %(default)s")
    add_number(options, "--repeats", 20, "runs of each", most=1000)
    chosen = options.parse_args()
    rows = [row for axes in chosen.axes for row in measured(axes, chosen.repeats)]
    heads = ("coupling", "axes", "ns a tick", "halves", "ratio")
    shown = (
        (row["kind"], row["axes"], f"{row['ns']:.0f}", f"{row['halves_ns']:.0f}", f"{row['ratio']:.3f}") for row in rows
    )
    print_table(heads, shown, table_file(chosen.json))
    write_json(chosen.json, {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
