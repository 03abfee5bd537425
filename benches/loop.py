"""How late the live loop wakes, beside cyclictest in the same run, alternately and under the same policy.

Required: p50 and p99 of the overshoot at most 1.2 times those of cyclictest.

Both wait for absolute deadlines of CLOCK_MONOTONIC, 1 ms apart, with locked memory: under SCHED_FIFO 80 where that is
allowed, else (and with `--policy other`) as ordinary threads. cyclictest does nothing between two deadlines; the loop
is the master's: it takes datagrams, ticks its endpoint and its simulated device, and sends a frame to a socket that
nobody reads. cyclictest comes with Debian's package rt-tests: apt-get install rt-tests.
"""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from _report import add_number, bench_options, print_requirements, print_table, table_file, write_json
from haptether.bridge import LiveMaster, MasterTable, OperatorTable, SafetyTable, Scene, SlaveTable, scene_json

EXAMPLE = "example: python benches/loop.py --rounds 10 --json -"
PRIORITY, PERIOD_US = 80, 1000
LONGEST_NS = 1_000_000
"""Largest overshoot that cyclictest resolves; larger ones are counted."""
REQUIRED = 1.2
SHARES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}


@dataclass(frozen=True, slots=True, kw_only=True)
class Round:
    """Overshoot in us of one run."""

    who: str
    wakes: int
    beyond: int
    """Wakes more than 1 ms late."""
    p50_us: float
    p99_us: float
    p999_us: float
    load_average: float


def quantiles(who: str, overshoot_ns: npt.NDArray[np.float64], beyond: int, load_average: float) -> Round:
    """Return the quantiles of one run; times beyond the histogram count as 1 ms."""
    p50, p99, p999 = (float(np.quantile(overshoot_ns, share)) / 1e3 for share in SHARES.values())
    return Round(
        who=who, wakes=overshoot_ns.size, beyond=beyond, p50_us=p50, p99_us=p99, p999_us=p999, load_average=load_average
    )


def cyclictest(policy: str, wakes: int) -> tuple[npt.NDArray[np.float64], int]:
    """Return the overshoots of cyclictest in ns, each wake once, and the number of wakes more than 1 ms late."""
    with tempfile.NamedTemporaryFile() as histogram:
        command = ["cyclictest", "-q", "-m", "-N", "-i", str(PERIOD_US), "-l", str(wakes), "-h", str(LONGEST_NS)]
        command += ["--policy", policy, *(["-p", str(PRIORITY)] if policy == "fifo" else [])]
        subprocess.run([*command, f"--histfile={histogram.name}"], check=True, stdout=subprocess.DEVNULL,
                       stderr=subprocess.DEVNULL)  # fmt: skip
        rows = [line.split() for line in Path(histogram.name).read_text().splitlines() if line[:1].isdigit()]
    late_ns, counts = (np.array([int(row[column]) for row in rows]) for column in (0, 1))
    beyond = max(wakes - int(counts.sum()), 0)
    seen = np.repeat(late_ns, counts).astype(np.float64)
    return np.concatenate([seen, np.full(beyond, float(LONGEST_NS))]), beyond


def live_loop(policy: str, wakes: int) -> tuple[npt.NDArray[np.float64], int, str]:
    """Return the same for the live loop, and its granted scheduling."""
    scene = Scene(
        schema=1,
        master=MasterTable(device="phantom-desktop"),
        operator=OperatorTable(stiffness=300.0, damping=8.0, grip_strength_n=12.0, clutch=()),
        slave=SlaveTable(),
        safety=SafetyTable(controllers=("hsc", "wsc")),
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        peer = f"127.0.0.1:{sink.getsockname()[1]}"
        master = LiveMaster(
            scene_json(scene),
            peer=peer,
            run_id=1,
            insecure=True,
            patience_s=wakes * PERIOD_US * 1e-6,
            realtime="auto" if policy == "fifo" else "off",
            priority=PRIORITY,
        )
        while not master.finished:
            # Not `poll`: the ring holds 65 s.
            time.sleep(0.2)
        realtime = master.realtime
        trace, report = master.finish()
    overshoot_ns = np.minimum(trace.overshoot_s * 1e9, LONGEST_NS)
    assert report.dropped_records == 0
    return overshoot_ns, int(np.count_nonzero(trace.overshoot_s * 1e9 >= LONGEST_NS)), realtime


def main() -> int:
    """Measure, print the table, and print if the requirement is met."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--rounds", 6, "turns of each", most=1000)
    add_number(options, "--seconds", 10.0, "of each turn", most=60.0)
    options.add_argument("--policy", choices=("fifo", "other"), help="by default fifo where it is allowed")
    arguments = options.parse_args()
    if shutil.which("cyclictest") is None:
        options.error("cyclictest is missing: apt-get install rt-tests")
    policy = arguments.policy or allowed_policy()
    wakes = round(arguments.seconds * 1e6 / PERIOD_US)

    out = table_file(arguments.json)
    print(f"overshoot in us, {wakes} wakes a turn, policy {policy}\n", file=out)
    rounds: list[Round] = []
    pooled: dict[str, list[npt.NDArray[np.float64]]] = {"cyclictest": [], "haptether": []}
    realtime = ""

    def measure(who: str) -> None:
        nonlocal realtime
        load_average = os.getloadavg()[0]
        if who == "cyclictest":
            overshoot_ns, beyond = cyclictest(policy, wakes)
        else:
            overshoot_ns, beyond, realtime = live_loop(policy, wakes)
        pooled[who].append(overshoot_ns)
        rounds.append(quantiles(who, overshoot_ns, beyond, load_average))

    def show(of: Iterable[Round]) -> None:
        rows = (
            (one.who, *(f"{us:.1f}" for us in (one.p50_us, one.p99_us, one.p999_us)), one.beyond,
             f"{one.load_average:.1f}")
            for one in of
        )  # fmt: skip
        print_table(("", "p50", "p99", "p99.9", "> 1 ms", "load average"), rows, out)

    for number in range(arguments.rounds):
        # The order alternates, so that a rising or falling load favours neither.
        order = ("cyclictest", "haptether") if number % 2 == 0 else ("haptether", "cyclictest")
        for who in order:
            measure(who)

    show(rounds)
    print("\nall turns together", file=out)
    together = {}
    for who, runs in pooled.items():
        beyond = sum(of.beyond for of in rounds if of.who == who)
        together[who] = quantiles(who, np.concatenate(runs), beyond, os.getloadavg()[0])
    show(together.values())
    ours, theirs = together["haptether"], together["cyclictest"]
    ratios = {name: getattr(ours, f"{name}_us") / getattr(theirs, f"{name}_us") for name in SHARES}
    print(f"\nthe loop's real time: {realtime}", file=out)
    print("times cyclictest: " + ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items()), file=out)
    met = {f"{name} at most {REQUIRED} times cyclictest": ratios[name] <= REQUIRED for name in ("p50", "p99")}
    status = print_requirements(met, out)
    write_json(
        arguments.json,
        {
            "policy": policy,
            "realtime": realtime,
            "rounds": [asdict(of) for of in rounds],
            "together": {who: asdict(of) for who, of in together.items()},
            "ratios": ratios,
            "met": met,
        },
    )
    return status


def allowed_policy() -> str:
    """Return the policy that this process may use."""
    try:
        before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        os.sched_setscheduler(0, before, parameter)
    except PermissionError:
        return "other"
    return "fifo"


if __name__ == "__main__":
    sys.exit(main())
