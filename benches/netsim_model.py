"""Cost of a verdict of the network model in virtual time, and of a link in a run of the engine.

Packets of one direction at 1 kHz go through `judge_all`. Beside it, NumPy draws the same delay, jitter and loss for all
packets at once, and Python's `random` draws them packet by packet. These peers keep no order, name no cause and key no
draw by its packet. A run of the engine is measured as in `scene_cost.py`: the time of a long run less that of a short
run, divided by the packets between them. All times are processor times.

Ends with status 1 if a link without a rule costs more than 10 % of a run.
"""

import os
import random
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import track

from _report import add_number, bench_options, in_turns, print_table, table_file, write_json
from haptether.bridge import Scene, simulate
from haptether.netsim import LinkSettings, judge_all

EXAMPLE = """example:
  .venv/bin/python benches/netsim_model.py --json -
"""
MAX_FOR_NO_RULE = 1.1
"""Cost of a run with a link without rules, relative to a run without a link."""
PERIOD_NS = 1_000_000
SIZE = 92
DELAY_S, JITTER_S, LOSS = 0.05, 0.005, 0.01
SHORT_S, LONG_S = 1.0, 21.0
PACKETS_PER_TICK = 2
"""One in each direction."""

Times: TypeAlias = npt.NDArray[np.int64]
Tables: TypeAlias = dict[str, Any]

DELAY: Tables = {"delay_s": DELAY_S}
INDEPENDENT: Tables = {**DELAY, "jitter_s": JITTER_S, "jitter_correlation_s": 0.0, "keep_order": False}
LINKS: dict[str, Tables] = {
    "no rule": {},
    "delay": DELAY,
    "delay, independent jitter": INDEPENDENT,
    "delay, correlated jitter": {**DELAY, "jitter_s": JITTER_S},
    "Bernoulli loss": {"loss": LOSS},
    "Gilbert loss": {"loss": LOSS, "mean_burst": 4.0},
    "delay, independent jitter, loss": {**INDEPENDENT, "loss": LOSS},
    "netem: delay, jitter, loss": {"netem": "delay 50ms 5ms distribution normal loss 1%"},
    "all that goes together": {
        **DELAY,
        "mtu": 1400,
        "loss": LOSS,
        "mean_burst": 4.0,
        "outages": [{"times": {"kind": "periodic", "at_s": 5.0, "period_s": 10.0, "duration_s": 0.05}}],
        "rate_bps": 2e6,
        "queue_ms": 50.0,
        "discipline": "codel",
        "cross_traffic": {"rate_bps": 5e5},
        "jitter_s": JITTER_S,
        "slots": {"period_s": 15.0, "level_s": 0.005},
        "reorder": 0.01,
        "duplicate": 0.01,
        "corrupt": 0.01,
        "truncate": 0.01,
        "truncate_bytes": 40,
        "attacks": [{"action": {"kind": "replay", "after_s": 0.1}, "target": {"probability": 0.01}}],
    },
}
PEERS = {"delay": "delay", "delay, jitter, loss": "delay, independent jitter, loss"}
"""Link that is equivalent to each peer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """ns per packet, least of the repeats; for a peer also relative to its equivalent link."""

    name: str
    ns: float
    ratio: float | None = None


def numpy_delay(sent_ns: Times) -> Times:
    """Return all arrivals at once."""
    return sent_ns + round(DELAY_S * 1e9)


def numpy_jitter_loss(sent_ns: Times) -> Times:
    """Return all arrivals at once; -1 for a lost packet."""
    random_numbers = np.random.default_rng(1)
    delay_s = np.maximum(random_numbers.normal(DELAY_S, JITTER_S, len(sent_ns)), 0.0)
    lost = random_numbers.random(len(sent_ns)) < LOSS
    return np.where(lost, -1, sent_ns + np.rint(delay_s * 1e9).astype(np.int64))


def python_delay(sent_ns: list[int]) -> list[int]:
    """Return the arrivals packet by packet."""
    delay_ns = round(DELAY_S * 1e9)
    return [sent + delay_ns for sent in sent_ns]


def python_jitter_loss(sent_ns: list[int]) -> list[int]:
    """Return the arrivals packet by packet; -1 for a lost one."""
    drawn = random.Random(1)
    due_ns = []
    for sent in sent_ns:
        delay_s = max(drawn.gauss(DELAY_S, JITTER_S), 0.0)
        due_ns.append(-1 if drawn.random() < LOSS else sent + round(delay_s * 1e9))
    return due_ns


def work(packets: int) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield everything that judges packets, by its name."""
    sent_ns = np.arange(packets, dtype=np.int64) * PERIOD_NS
    sizes = np.full(packets, SIZE, dtype=np.int64)
    sent = sent_ns.tolist()
    for name, tables in LINKS.items():
        settings = msgspec.convert(tables, LinkSettings)
        yield name, partial(judge_all, settings, sent_ns, sizes=sizes)
    yield "NumPy: delay", lambda: numpy_delay(sent_ns)
    yield "NumPy: delay, jitter, loss", lambda: numpy_jitter_loss(sent_ns)
    yield "Python: delay", lambda: python_delay(sent)
    yield "Python: delay, jitter, loss", lambda: python_jitter_loss(sent)


def scenes() -> Iterator[tuple[str, tuple[Scene, Scene]]]:
    """Yield a hand that trembles before a wall within an arm's reach, short and long, by its link."""
    base: Tables = {
        "schema": 1,
        "master": {"device": "phantom-desktop"},
        "operator": {"start": 0.02, "damping": 8.0, "tremor": {"amplitude": 1e-3, "frequency_hz": 5.0}},
        "slave": {},
    }
    links: dict[str, Tables] = {
        "engine, no [link]": {},
        "engine, [link] without a rule": {"link": {"forward": {}, "backward": {}}},
        "engine, delay": {"link": {"forward": DELAY, "backward": DELAY}},
        "engine, clocks that drift": {
            "link": {"master_clock": {"drift_ppm": 50.0}, "slave_clock": {"drift_ppm": -50.0}}
        },
    }
    for name, link in links.items():
        short, long = (
            msgspec.convert({**base, **link, "run": {"duration_s": lasts}}, Scene) for lasts in (SHORT_S, LONG_S)
        )
        yield name, (short, long)


def main() -> int:
    """Measure, print, and check."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--packets", 1_000_000, "of each link")
    add_number(options, "--repeats", 5, "the least time counts")
    arguments = options.parse_args()

    out = table_file(arguments.json)
    judged, run = dict(work(arguments.packets)), dict(scenes())
    works = judged | {
        f"{name}, {place}": partial(simulate, pair[place]) for name, pair in run.items() for place in (0, 1)
    }
    rounds = track(range(arguments.repeats), "packets", console=Console(stderr=True), transient=True)
    least_ns = {name: min(times) for name, times in in_turns(works, rounds, time.process_time_ns).items()}
    min_ns = {name: least_ns[name] / arguments.packets for name in judged}

    costs = [Cost(name=name, ns=min_ns[name]) for name in LINKS]
    for language in ("NumPy", "Python"):
        for peer, link in PEERS.items():
            name = f"{language}: {peer}"
            costs.append(Cost(name=name, ns=min_ns[name], ratio=min_ns[name] / min_ns[link]))
    packets = (LONG_S - SHORT_S) * 1e9 / PERIOD_NS * PACKETS_PER_TICK
    per_packet = {name: (least_ns[f"{name}, 1"] - least_ns[f"{name}, 0"]) / packets for name in run}
    base = per_packet["engine, no [link]"]
    engine = [Cost(name=name, ns=ns, ratio=ns / base) for name, ns in per_packet.items()]

    load = os.getloadavg()[0]
    print(f"{arguments.packets} packets, least of {arguments.repeats}, load {load:.1f}\n", file=out)
    verdicts = (
        (cost.name, f"{cost.ns:.1f}", f"{1e3 / cost.ns:.1f}", None if cost.ratio is None else f"{cost.ratio:.2f}")
        for cost in costs
    )
    print_table(("", "ns per packet", "1e6 per s", "x the link that does the same"), verdicts, out)
    print(file=out)
    in_runs = ((cost.name, f"{cost.ns:.1f}", f"{cost.ratio:.2f}") for cost in engine)
    print_table(("", "ns per packet", "x without a link"), in_runs, out)

    no_rule = per_packet["engine, [link] without a rule"] / base
    missed = [f"a link without a rule: {no_rule:.2f} x, must be at most {MAX_FOR_NO_RULE}"]
    if no_rule <= MAX_FOR_NO_RULE:
        missed = []
    print(f"\n{'; '.join(missed) or 'all as required'}", file=out)

    report = {
        "packets": arguments.packets,
        "repeats": arguments.repeats,
        "load": load,
        "verdicts": [asdict(cost) for cost in costs],
        "engine": [asdict(cost) for cost in engine],
        "missed": missed,
    }
    write_json(arguments.json, report)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
