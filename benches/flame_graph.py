"""Where the time of a simulated tick goes: stacks sampled by `perf` while a scene runs, by part and as a flame graph.

Each checkout runs the scene with its own built extension; a release build measures what users run. `--before CHECKOUT`
compares with another tree. `--keep FILE` writes the stacks, and `--before FILE` compares with written ones.

Times are shares of the samples times the processor time of a tick, least of some runs. An inlined function appears as a
frame of its own, as in the extension's line tables. Needs `perf` (package linux-perf), `addr2line` (binutils) and
permission to sample (`kernel.perf_event_paranoid` at most 2).
"""

import json
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from _report import bench_options, table_file, write_json
from haptether.view.style.figure import figure_of, fitted, new_figure, write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EXAMPLE = "example: python benches/flame_graph.py --before benches/profiles/remote_push_before.json --plot flame.png"
ROOT = Path(__file__).resolve().parents[1]
EXTENSION = Path("python", "haptether", "_core.abi3.so")
RUN = """
import sys, time
import haptether
scene, seconds, repeats, overrides = sys.argv[1], float(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
overrides = [f"run.duration_s={seconds}", *overrides]
# Imports and one-time construction are not part of a tick.
haptether.simulate(scene, overrides=["run.duration_s=0.5"])
least = float("inf")
for _ in range(repeats):
    begun = time.process_time()
    run = haptether.simulate(scene, overrides=overrides)
    least = min(least, (time.process_time() - begun) / run.metrics.ticks * 1e9)
print(least)
"""
PARTS = (
    ("arm and contact", r"^haptether_slave::"),
    ("verdicts of the network", r"^(<?haptether_netsim::|libm::)"),
    ("device and hand", r"^haptether_master::"),
    ("observers, controllers, limiter", r"^haptether_safety::"),
    ("ladder", r"^haptether_bridge::ladder(::|$)"),
    ("frames and link", r"^haptether_bridge::(wire|link|session|endpoint::exchange)(::|$)"),
    ("age, clock and counts of the path", r"^haptether_bridge::path(::|$)"),
    ("endpoints and coupling", r"^haptether_bridge::(endpoint|coupling|hand)"),
    ("measures, events, signals", r"^haptether_bridge::scene(::|$)"),
    ("copies of memory", r"^_*mem(cpy|move|set)"),
    ("sides, loops and what is inlined there", r"^<?haptether_bridge::"),
)
"""Parts by the innermost function of ours in a sample; the first match counts."""
ROOT_FRAMES = (
    "haptether_bridge::virtual_time::run_virtual",
    "haptether_bridge::virtual_time::run_virtual_batched",
    "haptether_bridge::scene::bilateral::run",
)
"""Functions that run a scene: the compiler may inline the first two into the last."""
Stack = tuple[str, ...]


def sample(
    checkout: Path, scene: str, seconds: float, repeats: int, overrides: Iterable[str]
) -> tuple[Counter[Stack], float]:
    """Return stacks below the run of a scene, outermost first, with their counts, and the time of a tick in ns."""
    if checkout.is_file():
        profile = json.loads(checkout.read_text(encoding="utf-8"))
        return Counter({tuple(stack): count for *stack, count in profile["stacks"]}), profile["ns"]
    with tempfile.TemporaryDirectory() as folder:
        recorded = str(Path(folder, "perf.data"))
        run, once = ([sys.executable, "-c", RUN, scene, str(seconds), str(n), *overrides] for n in (repeats, 1))
        perf = ["perf", "record", "-q", "-F", "1500", "--call-graph", "dwarf,16384", "-o", recorded, "--", *once]
        environment = {"PYTHONPATH": str(checkout / "python"), "PATH": "/usr/bin:/bin"}
        plain = subprocess.run(run, check=True, capture_output=True, text=True, env=environment, timeout=300)
        subprocess.run(perf, check=True, capture_output=True, text=True, env=environment, timeout=300)
        script = ["perf", "script", "--no-inline", "-i", recorded, "-F", "ip,sym,dso"]
        printed = subprocess.run(script, check=True, capture_output=True, text=True, timeout=600).stdout
    blocks = [[line for line in block.splitlines() if line.strip()] for block in printed.split("\n\n")]
    inlined = inlined_at({place for block in blocks for place in addresses(block)}, checkout / EXTENSION)
    stacks: Counter[Stack] = Counter()
    for block in blocks:
        frames: list[str] = []
        for line, place in zip(block, addresses(block), strict=True):
            frames += inlined.get(place) or [function_name(line.split(None, 1)[1].rpartition(" (")[0])]
        frames.reverse()
        of_run = [place for place, frame in enumerate(frames) if frame in ROOT_FRAMES]
        if of_run:
            stacks[(ROOT_FRAMES[0], *frames[of_run[-1] + 1 :])] += 1
    if not stacks:
        sys.exit(
            f"no sample of {checkout} lies in {' or '.join(ROOT_FRAMES)}: its extension has no symbols; build it with "
            "`cargo build --release -p haptether-python` and copy target/release/lib_core.so to "
            "python/haptether/_core.abi3.so"
        )
    return stacks, float(plain.stdout)


def addresses(block: list[str]) -> list[int]:
    """Return the frame addresses of a sample in the extension, -1 for frames elsewhere, innermost first."""
    of_lines = [int(line.split(None, 1)[0], 16) if f"/{EXTENSION.name})" in line else -1 for line in block]
    # The address of a caller is the one after its call.
    return [place - 1 if index and place > 0 else place for index, place in enumerate(of_lines)]


def inlined_at(places: set[int], extension: Path) -> dict[int, list[str]]:
    """Return the functions at each address of the extension, innermost first."""
    asked = sorted(place for place in places if place > 0)
    shift = code_shift(extension)
    command = ["addr2line", "--inlines", "--functions", "--demangle", "--addresses", "--exe", str(extension)]
    lines = "\n".join(f"{place + shift:#x}" for place in asked)
    printed = subprocess.run(command, input=lines, check=True, capture_output=True, text=True, timeout=600).stdout
    found: dict[int, list[str]] = {}
    for block in re.split(r"^0x", printed, flags=re.MULTILINE)[1:]:
        # The address, then function and location of each.
        place, *named = block.splitlines()
        pairs = [pair for pair in zip(named[::2], named[1::2], strict=True) if pair[0] != "??"]
        found[int(place, 16) - shift] = [function_at(*pair) for pair in pairs]
    return found


def code_shift(extension: Path) -> int:
    """Return code addresses minus their places in the file, which `perf` prints below a stack."""
    image = extension.read_bytes()
    (table,) = struct.unpack_from("<Q", image, 32)
    size, count = struct.unpack_from("<HH", image, 54)
    for entry in range(count):
        kind, flags, offset, address = struct.unpack_from("<IIQQ", image, table + entry * size)
        if (kind, flags & 1) == (1, 1):
            return int(address - offset)
    sys.exit(f"{extension}: has no code")


def function_at(function: str, location: str) -> str:
    """Return a function with the module of its file, if it is one of ours: line tables have no modules."""
    ours = re.search(r"/(bridge|master|netsim|safety|slave)/src/(.+)\.rs:", location)
    name = function_name(function)
    if ours is None:
        return name
    module = f"haptether_{ours[1]}::{ours[2].removesuffix('/mod').replace('/', '::')}"
    # For an inlined function, its name may be all that is known.
    return module if "::" in name else f"{module}::{name}"


def function_name(name: str) -> str:
    """Return a function name without its hash and type parameters."""
    name = re.sub(r"::h[0-9a-f]{16}$", "", name.strip())
    depth, letters = 0, []
    for place, letter in enumerate(name):
        if letter == "<" and place > 0:
            depth += 1
        elif letter == ">" and depth > 0:
            depth -= 1
        elif depth == 0:
            letters.append(letter)
    return "".join(letters)


def by_part(stacks: Counter[Stack], ns: float) -> dict[str, float]:
    """Return the time of a tick in ns by part, without functions of other parts that it calls."""
    total = sum(stacks.values())
    spent = dict.fromkeys([*(name for name, _ in PARTS), "else"], 0.0)
    for stack, count in stacks.items():
        spent[part_of(stack)] += count / total * ns
    return spent


def part_of(stack: Stack) -> str:
    """Return the part of the innermost function that has one: the standard library counts for its caller."""
    fits = (name for frame in reversed(stack) for name, pattern in PARTS if re.search(pattern, frame))
    return next(fits, "else")


def draw(drawn: dict[str, tuple[Counter[Stack], float]], path: Path) -> None:
    """Draw flame graphs, one below the other, on one time scale."""
    most = max(ns for _, ns in drawn.values())
    figure = new_figure(2, 3.0 * len(drawn), "Time of a remote tick by function")
    panels = figure.subplots(len(drawn), 1, squeeze=False)[:, 0]
    for panel, (title, (stacks, ns)) in zip(panels, drawn.items(), strict=True):
        panel.set_title(f"{title}: {ns:.0f} ns a tick", loc="left")
        panel.set_xlim(0.0, most)
        panel.set_yticks([])
        panel.set_xlabel("ns")
        total = sum(stacks.values())
        deepest = rectangles(panel, stacks, 0.0, 0, ns / total)
        panel.set_ylim(0.0, deepest + 1.0)
    write_figure(figure, path)


def rectangles(panel: "Axes", stacks: Counter[Stack], left: float, level: int, scale: float) -> int:
    """Draw the frames of one level and above; return the deepest level."""
    groups: dict[str, Counter[Stack]] = {}
    _, most = panel.get_xlim()
    for stack, count in stacks.items():
        if stack:
            groups.setdefault(stack[0], Counter())[stack[1:]] += count
    deepest = level
    for name, inside in sorted(groups.items()):
        width = sum(inside.values()) * scale
        if width > 0.003 * most:
            place = next((place for place, (_, pattern) in enumerate(PARTS) if re.search(pattern, name)), len(PARTS))
            colour = f"C{place % 10}"
            panel.barh(level + 0.5, width, 0.96, left, color=colour, alpha=0.45, edgecolor="white", linewidth=0.4)
            room = width / most * panel.get_window_extent().width - 4.0
            short = "::".join(name.split("::")[-2:])
            label = fitted(figure_of(panel), short, room, 5.0) if room > 20.0 else ""
            panel.text(left + 0.002 * most, level + 0.5, label, va="center", fontsize=5, clip_on=True)
            deepest = max(deepest, rectangles(panel, inside, left, level + 1, scale))
        left += width
    return deepest


def main() -> int:
    """Sample, print the table, draw."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--scene", default="remote_push", help="default %(default)s")
    options.add_argument("--seconds", type=float, default=300.0, help="simulated; default %(default)s")
    options.add_argument("--set", action="append", default=[], metavar="TABLE.KEY=VALUE", help="fields to change")
    options.add_argument(
        "--before", type=Path, metavar="CHECKOUT|FILE", help="another tree, or what --keep has written"
    )
    options.add_argument("--keep", type=Path, metavar="FILE", help="write stacks and time as JSON")
    options.add_argument("--repeats", type=int, default=5, help="runs whose least counts; default %(default)s")
    options.add_argument("--plot", type=Path, metavar="FILE", help="the flame graphs as a picture")
    chosen = options.parse_args()
    for program, package in (("perf", "linux-perf"), ("addr2line", "binutils")):
        if shutil.which(program) is None:
            options.error(f"{program} is not there: install {package}")
    if chosen.repeats < 1:
        options.error("--repeats must be 1 or more")
    if not 1.0 <= chosen.seconds <= 3600.0:
        options.error("--seconds must be 1 to 3600")
    trees = {"now": ROOT} if chosen.before is None else {"before": chosen.before.resolve(), "now": ROOT}
    overrides = [*chosen.set, "record.every=1000"]
    drawn = {
        name: sample(tree, chosen.scene, chosen.seconds, chosen.repeats, overrides) for name, tree in trees.items()
    }
    if chosen.keep is not None:
        stacks, ns = drawn["now"]
        rows = [[*stack, count] for stack, count in sorted(stacks.items())]
        chosen.keep.write_text(json.dumps({"ns": round(ns), "stacks": rows}, indent=0), encoding="utf-8")
    spent = {name: by_part(stacks, ns) for name, (stacks, ns) in drawn.items()}
    out = table_file(chosen.json)
    print(f"{'ns a tick':42}" + "".join(f"{name:>10}" for name in drawn), file=out)
    for part in spent["now"]:
        print(f"{part:42}" + "".join(f"{spent[name][part]:10.0f}" for name in drawn), file=out)
    print(f"{'all':42}" + "".join(f"{ns:10.0f}" for _, ns in drawn.values()), file=out)
    if chosen.plot is not None:
        draw(drawn, chosen.plot)
    write_json(chosen.json, {name: {"ns": drawn[name][1], "parts_ns": spent[name]} for name in drawn})
    return 0


if __name__ == "__main__":
    sys.exit(main())
