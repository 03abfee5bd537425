"""The scene of two sides that tests modify: a hand presses a soft wall through an arm."""

from typing import Any

import msgspec

from haptether.bridge import LoopReport, Run, Scene

PRESS: dict[str, Any] = {
    "schema": 1,
    "master": {"device": "phantom-desktop"},
    "operator": {
        "stiffness": 300.0,
        "damping": 8.0,
        "grip_strength_n": 12.0,
        "start": 0.02,
        "legs": [{"duration_s": 1.0, "end": -0.03}],
        "clutch": "once",
    },
    "slave": {},
    "environment": {"objects": [{"contact": {"stiffness": 100.0}}]},
    "record": {},
}


def two_sides(**changed: Any) -> Scene:  # noqa: ANN401  # tables as in TOML
    """Return the scene with some keys of its tables changed; None leaves a table out."""
    tables = {**PRESS}
    for table, fields in changed.items():
        tables[table] = fields and {**tables.get(table, {}), **fields}
    return msgspec.convert(tables, Scene)


def reports(run: Run) -> tuple[LoopReport, LoopReport]:
    """Return the loop reports of master and slave."""
    assert run.reports is not None
    return run.reports
