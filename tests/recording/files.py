"""Recordings of known content, written with the library of the format."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

BEGUN_NS = 1_790_000_000_000_000_000
SCENE = {"schema": 1, "run": {"seed": 7}}

MASTER = {
    "position": [0.0], "true_position": [0.0], "velocity": [0.0], "hand_force": [0.0], "rendered_force": [0.0],
    "device_force": [0.0], "trigger": None, "tripped": 0, "state": "disengaged", "reason": "", "peer_state": "",
    "clutch": False, "age_s": None, "overshoot_s": 0.0, "acted": 0,
}  # fmt: skip
SLAVE = {
    "position": [0.0], "command": [0.0], "environment_force": [0.0], "gripper": None, "gripper_command": None,
    "gripper_force": None, "holds_object": False, "limited": 0, "state": "disengaged", "reason": "", "peer_state": "",
    "overshoot_s": 0.0,
}  # fmt: skip
TICK_NS = 1_000_000


def write_recording(
    path: Path,
    side: str,
    ticks: Sequence[Mapping[str, Any]],
    *,
    begun_ns: int = BEGUN_NS,
    scene: Mapping[str, Any] | None = SCENE,
    causes: Sequence[Mapping[str, Any]] = (),
    schema: str = "1",
    compression: CompressionType = CompressionType.NONE,
) -> Path:
    """Write a file like the recorder does: each tick changes the previous one, from `MASTER` or `SLAVE` on."""
    tick = {"time_ns": 0, **(MASTER if side == "master" else SLAVE)}
    names = {name for one in ticks for name in one} | set(tick)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 12, compression=compression)
        writer.start(profile="haptether", library="a test")
        about = {"schema": schema, "side": side, "security": "secure"}
        kept = {} if scene is None else {"version": "0.1.0", "scene": json.dumps(scene)}
        writer.add_metadata("haptether", about | kept)
        properties = {name: {"description": f"{name} of a test"} for name in sorted(names)}
        described = writer.register_schema(
            f"haptether.{side}", "jsonschema", json.dumps({"properties": properties}).encode()
        )
        channel = writer.register_channel(f"/{side}", "json", described)
        noted = writer.register_channel(
            f"/{side}/cause", "json", writer.register_schema("haptether.cause", "jsonschema", b"{}")
        )
        for number, changes in enumerate(ticks):
            tick = tick | {"time_ns": number * TICK_NS} | dict(changes)
            at_ns = begun_ns + number * TICK_NS
            writer.add_message(channel, at_ns, json.dumps(tick).encode(), at_ns)
        for cause in causes:
            writer.add_message(noted, begun_ns, json.dumps(cause).encode(), begun_ns)
        writer.finish()  # type: ignore[no-untyped-call]  # of the library
    return path
