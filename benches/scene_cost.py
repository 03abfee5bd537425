"""Cost of a scene per tick, proof that it pays only for what it uses, and the time of commands before they begin.

Each row is a scene that differs from its base in one thing. The time of a tick is that of a long run less that of a
short run, divided by the ticks between them; this leaves out one-time setup. Ticks are timed by the clock, all scenes
in turns, the least of the repeats. On a virtual machine the processor's own account is too coarse for some
milliseconds. The time of a process is processor time.

Ends with status 1 if

- an exact tick without an arm takes longer than required,
- 1000 objects out of reach cost more than 1.5 times as much as none,
- `haptether --help` takes longer than it may, or
- running a scene loads a library that it does not use.
"""

import math
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import msgspec
from rich.console import Console
from rich.progress import track

from _report import add_number, bench_options, print_table, table_file, write_json
from haptether.bridge import Scene, scene_json, simulate
from haptether.cli.entry import COMMANDS

EXAMPLE = """example:
  .venv/bin/python benches/scene_cost.py --json -
"""
SHORT_S, LONG_S = 1.0, 101.0
MAX_FOR_OBJECTS = 1.5
"""Cost of 1000 objects out of reach, relative to none."""
MAX_TICK_NS = {"local, 1 axis": 60.0, "local, 3 axes": 350.0}
"""Required time of an exact tick with the safety layer; on three axes with friction along the motion."""
MAX_FOR_HELP_S = 0.4
PROCESSES = 5
UNUSED = ("casadi", "matplotlib", "pyvista", "rtde_control", "rtde_receive", "scipy")

Tables = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """Scene, and the row for comparison."""

    name: str
    scene: Tables
    base: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """ns per tick, least of the repeats, and relative to the base."""

    name: str
    ns: float
    base: str | None
    ratio: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Times in s of a fresh process, least of the repeats."""

    name: str
    seconds: float


def scene(axes: int = 1, *, arm: bool = False, depth: float = -0.02, **tables: Tables) -> Tables:
    """Return a hand that trembles at `depth` in m inside a wall; if negative, before it."""
    wall = {"shape": {"kind": "plane"}, "contact": {"stiffness": 200.0}}
    start = [-depth] + [0.0] * (axes - 1)
    common: Tables = {
        "schema": 1,
        "master": {"device": "phantom-desktop", "axes": axes},
        "operator": {"start": start, "damping": 8.0, "tremor": {"amplitude": 1e-3, "frequency_hz": 5.0}},
        "environment": {"objects": [wall]},
        **tables,
    }
    return common | ({"slave": {}} if arm else {})


def far(count: int) -> Tables:
    """Return `count` balls out of reach."""
    ball = {"contact": {"stiffness": 500.0}}
    return {
        "objects": [
            {"shape": {"kind": "sphere", "centre": [0.5 + 0.01 * n, 0.0, 0.0], "radius": 0.05}, **ball}
            for n in range(count)
        ]
    }


def rows() -> Iterator[Row]:
    """Yield all rows of the table, each after its base."""
    yield Row(name="local, 1 axis", scene=scene())
    yield Row(name="local, 3 axes", scene=scene(3), base="local, 1 axis")
    joints = {"device": "phantom-desktop", "axes": 3, "friction": "axis"}
    yield Row(name="local, 3 axes, friction on each", scene=scene(3, master=joints), base="local, 1 axis")
    yield Row(name="in contact", scene=scene(depth=0.02), base="local, 1 axis")
    yield Row(name="WSC", scene=scene(safety={"controllers": ["wsc"]}), base="local, 1 axis")
    all_four = {"controllers": ["vfc", "hsc", "wsc", "pc"]}
    yield Row(name="VFC + HSC + WSC + PC", scene=scene(safety=all_four), base="local, 1 axis")
    yield Row(name="recorded", scene=scene(record={}), base="local, 1 axis")
    for where, arm in (("local", False), ("bilateral", True)):
        base = f"{where}, 3 axes, 0 objects"
        yield Row(name=base, scene=scene(3, arm=arm, environment=far(0)))
        for count in (10, 1000):
            crowded = scene(3, arm=arm, environment=far(count))
            yield Row(name=f"{where}, 3 axes, {count} out of reach", scene=crowded, base=base)
    yield Row(name="bilateral, 1 axis", scene=scene(arm=True), base="local, 1 axis")
    yield Row(name="bilateral, in contact", scene=scene(arm=True, depth=0.02), base="bilateral, 1 axis")


def run_s(scene: Scene) -> float:
    """Return the time in s of a run.

    The scene is checked first: the check of 1000 objects takes longer than 10 000 ticks.
    """
    scene_json(scene)
    times = []
    # After another scene, the first run allocates again the memory that the previous run freed.
    for _ in range(2):
        begun = time.perf_counter()
        simulate(scene)
        times.append(time.perf_counter() - begun)
    return min(times)


def ticks_ns(found: list[Row], repeats: int) -> Iterator[list[float]]:
    """Yield the time of one tick of each scene in ns, refined from round to round.

    All scenes take turns, so that a temporary load of the machine affects all of them.
    """

    def lasting(tables: Tables, duration_s: float) -> Scene:
        return msgspec.convert(tables | {"run": tables.get("run", {}) | {"duration_s": duration_s}}, Scene)

    scenes = [(lasting(row.scene, SHORT_S), lasting(row.scene, LONG_S)) for row in found]
    fastest = [[math.inf, math.inf] for _ in found]
    for _ in range(repeats):
        for known, pair in zip(fastest, scenes, strict=True):
            known[:] = [min(s, run_s(one)) for s, one in zip(known, pair, strict=True)]
        yield [(long - short) / (LONG_S - SHORT_S) * 1e6 for short, long in fastest]


def process_s(*command: str) -> float:
    """Return the time of a process in s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, timeout=60)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def starts() -> list[Start]:
    """Time the import, and the help of every command."""
    program = (sys.executable, "-m", "haptether")
    found = [
        ("python alone", (sys.executable, "-c", "pass")),
        ("import haptether", (sys.executable, "-c", "import haptether")),
        ("haptether --help", (*program, "--help")),
    ]
    found += [(f"haptether {name} --help", (*program, name, "--help")) for name in COMMANDS]
    rounds = [[process_s(*command) for _, command in found] for _ in range(PROCESSES)]
    return [
        Start(name=name, seconds=min(times)) for (name, _), times in zip(found, zip(*rounds, strict=True), strict=True)
    ]


def loaded_needlessly() -> list[str]:
    """Return the libraries that a scene's run loads without using them."""
    program = f"""
import sys
from haptether.cli import main
main(["simulate", "remote_push", "--json", "-"])
print(*sorted(set({UNUSED!r}) & set(sys.modules)), file=sys.stderr)
"""
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    return answer.stderr.splitlines()[-1].split()


def main() -> int:
    """Measure, print, and check."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--repeats", 21, "runs of each scene")
    arguments = options.parse_args()

    out = table_file(arguments.json)
    costs: dict[str, Cost] = {}
    found = list(rows())
    turns = ticks_ns(found, arguments.repeats)
    for times in track(turns, "scenes", total=arguments.repeats, console=Console(stderr=True), transient=True):
        for row, ns in zip(found, times, strict=True):
            ratio = None if row.base is None else ns / costs[row.base].ns
            costs[row.name] = Cost(name=row.name, ns=ns, base=row.base, ratio=ratio)
    begins = starts()
    needless = loaded_needlessly()

    ticks = (
        (cost.name, f"{cost.ns:.0f}", *((None, None) if cost.ratio is None else (f"{cost.ratio:.2f}", cost.base)))
        for cost in costs.values()
    )
    print_table((f"least of {arguments.repeats}", "ns per tick", "times", "base"), ticks, out)
    print(file=out)
    processes = ((start.name, f"{start.seconds:.3f}") for start in begins)
    print_table((f"a fresh process, least of {PROCESSES}", "s"), processes, out)

    missed = [
        f"{cost.name}: {cost.ratio:.2f} x, must be at most {MAX_FOR_OBJECTS}"
        for cost in costs.values()
        if "1000 out of reach" in cost.name and cost.ratio is not None and cost.ratio > MAX_FOR_OBJECTS
    ]
    missed += [
        f"{name}: {costs[name].ns:.0f} ns a tick, must be at most {most:.0f}"
        for name, most in MAX_TICK_NS.items()
        if costs[name].ns > most
    ]
    help_s = next(start.seconds for start in begins if start.name == "haptether --help")
    if help_s > MAX_FOR_HELP_S:
        missed.append(f"haptether --help: {help_s:.3f} s, must be at most {MAX_FOR_HELP_S}")
    if needless:
        missed.append(f"haptether simulate loads {', '.join(needless)}")
    print(f"\n{'; '.join(missed) or 'all as required'}", file=out)

    report = {
        "repeats": arguments.repeats,
        "costs": [asdict(cost) for cost in costs.values()],
        "starts": [asdict(start) for start in begins],
        "needless": needless,
        "missed": missed,
    }
    write_json(arguments.json, report)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
