"""Engagements of an emulated UR arm: `python -m tests.ur.engagements --count 100 --busy 2 --json out/engaged.json`.

Each start has its own controller and `haptether slave`, and a master that waits. The first engagement thus meets the
first calls of each process; further ones follow by the clutch. A frame is late if either side takes the other for
silent (STALE after 5 ms, HOLD after 20 ms) within 0.35 s of an engagement. A start with late frames runs again if a
processor stalled in it, as seen by a sleeper above all loops: then the machine is the cause.
"""

import argparse
import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.ur.emulated import emulator
from tests.ur.endurance import steal_s
from tests.ur.machine_stalls import machine_stalls

from haptether.bridge import LiveMaster, ladder_state_name, load_scene, scene_json

SCENE = "ur_peg"
WINDOW_S = 0.35
"""Time after an engagement in which a late frame counts, in s; the next press comes later."""
OPEN_S = 40.0
PRESS_S = 3.0
"""Longest time for a press to engage, in s: 0.1 s of released clutch, and a few frames each way."""
ENDS_S = 15.0
STALL_S = 0.003
"""Shortest stall of a processor that may delay a frame, in s: the loop waits for 2 ms in any case."""
LATE = frozenset({"stale", "hold", "stop", "fault"})
POLL_S = 0.002

Signals = Mapping[str, npt.NDArray[Any]]


def engagements(ticks: Signals) -> list[dict[str, Any]]:
    """Return each engagement in a trace: its time, the late states within the window, and the delay of the loop.

    Args:
        ticks: `time_s`, `state` as of `ladder_state_name`, and `overshoot_s`, shape (n_ticks,) each.
    """
    names = [ladder_state_name(int(code)) for code in ticks["state"]]
    time_s, found = ticks["time_s"], []
    for tick in range(1, len(names)):
        if names[tick] != "engaged" or names[tick - 1] in {"engaged", "stale"}:
            continue
        last = int(np.searchsorted(time_s, time_s[tick] + WINDOW_S))
        # A released clutch ends the window.
        going = next((n for n in range(tick, last) if names[n] in {"disengaged", "aligning"}), last)
        begun = [n for n in range(tick + 1, going) if names[n] in LATE and names[n] != names[n - 1]]
        found.append({
            "at_s": float(time_s[tick]),
            "late": [[names[n], 1e3 * float(time_s[n] - time_s[tick])] for n in begun],
            "overshoot_ms": 1e3 * float(ticks["overshoot_s"][tick:going].max(initial=0.0)),
        })  # fmt: skip
    return found


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Run that many processes that only compute."""
    children = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()


def engaged(master: LiveMaster) -> bool:
    """Wait until a press has engaged; return false after a timeout."""
    end_s = time.monotonic() + PRESS_S
    while time.monotonic() < end_s:
        if master.state == "engaged":
            return True
        time.sleep(POLL_S)
    return False


def undisturbed(count: int, folder: Path, attempts: int) -> dict[str, Any]:
    """Return figures of a start: of the first attempt without a late frame by the machine, or of the last one."""
    for attempt in range(1, attempts + 1):
        with machine_stalls() as stalls:
            run = started(count, folder)
        run["machine_stalls_ms"] = [1e3 * late_s for at_s, late_s in stalls if at_s > run["engaged_at_s"]]
        run["attempt"] = attempt
        late = any(one["late"] for side in ("master", "slave") for one in run[side])
        if not late or max(run["machine_stalls_ms"], default=0.0) < 1e3 * STALL_S:
            break
    return run


def started(count: int, folder: Path) -> dict[str, Any]:
    """Return figures of one start with that many engagements."""
    path = folder / "slave.npz"
    path.unlink(missing_ok=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    with emulator("--scene", SCENE) as running:
        command = [
            sys.executable, "-m", "tests.ur.engaging", str(path), "--listen", address, "--insecure", "--scene", SCENE,
            "--set", f"slave.options.host={running.host}", "--patience-s", str(OPEN_S),
        ]  # fmt: skip
        # The master starts first: it engages as soon as the slave is ready.
        spec = scene_json(load_scene(SCENE))
        master = LiveMaster(spec, peer=address, run_id=time.time_ns() >> 8, insecure=True, patience_s=OPEN_S)
        slave = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        try:
            end_s = time.monotonic() + OPEN_S
            while master.state != "engaged" and time.monotonic() < end_s and slave.poll() is None:
                time.sleep(POLL_S)
            engaged_at_s = time.monotonic()
            running.do("forget-lateness")
            for _ in range(count - 1):
                time.sleep(WINDOW_S + 0.05)
                master.press_clutch()
                # The clutch is released first.
                time.sleep(0.05)
                engaged(master)
            time.sleep(WINDOW_S)
            trace, _ = master.finish()
            status = running.status()
            slave.terminate()
            _, said = slave.communicate(timeout=ENDS_S)
        finally:
            slave.kill()
            slave.wait()
    near: Signals = {"time_s": trace.time_s, "state": trace.state, "overshoot_s": trace.overshoot_s}
    far: dict[str, Any] = {}
    with contextlib.suppress(OSError), np.load(path) as arrays:
        far = dict(arrays)
    return {
        "asked": count,
        "engaged_at_s": engaged_at_s,
        "master": engagements(near),
        "slave": engagements(far) if far else [],
        "emulator_worst_late_ms": 1e3 * status["worst_late_s"],
        "emulator_busiest_ms": 1e3 * status["busiest_s"],
        **({} if far else {"slave_said": said.decode(errors="replace")[-2000:]}),
    }


def measured(count: int, each: int, beside: int, attempts: int, steps: Callable[[str], None]) -> dict[str, Any]:
    """Return figures of `count` engagements, `each` per start, beside that many busy processes."""
    begun_s, stolen_s = time.monotonic(), steal_s()
    runs: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder, busy(beside):
        while (left := count - sum(run["asked"] for run in runs)) > 0:
            runs.append(undisturbed(min(each, left), Path(folder), attempts))
            steps(_row(len(runs), runs[-1]))
    sides = {side: [found for run in runs for found in run[side]] for side in ("master", "slave")}
    late = {side: [found for found in sides[side] if found["late"]] for side in sides}
    result: dict[str, Any] = {
        "asked": count, "starts": len(runs), "busy": beside, "elapsed_s": time.monotonic() - begun_s,
        "stolen_s": steal_s() - stolen_s, "measured_anew": sum(run["attempt"] - 1 for run in runs),
    }  # fmt: skip
    for side, found in sides.items():
        wakes = np.array([one["overshoot_ms"] for one in found] or [np.nan])
        result[side] = {
            "engaged": len(found),
            "with_late_frames": len(late[side]),
            "held": sum(any(name != "stale" for name, _ in one["late"]) for one in found),
            "wakes_late_median_ms": float(np.median(wakes)),
            "wakes_late_max_ms": float(wakes.max()),
        }
    result["good"] = all(len(sides[side]) >= count and not late[side] for side in sides)
    return {**result, "runs": runs}


def _row(number: int, run: dict[str, Any]) -> str:
    """Format a line of the table."""
    cells = [f"{number:5} {run['asked']:7}"]
    for side in ("master", "slave"):
        found = run[side]
        late = [f"{name} {at_ms:.0f} ms" for one in found for name, at_ms in one["late"]]
        worst = max((one["overshoot_ms"] for one in found), default=float("nan"))
        cells.append(f"{len(found):4} {sum(bool(one['late']) for one in found):5} {worst:9.2f}  {', '.join(late)}")
    stalled_ms = max(run["machine_stalls_ms"], default=0.0)
    cells.append(f"{run['emulator_worst_late_ms']:9.2f} | {stalled_ms:7.2f} | {run['attempt']:7}")
    return " | ".join(cells)


HEADINGS = (
    "start   asked | master: engaged, late, worst wake [ms] | slave: the same | emulator late [ms] | machine [ms] |"
    " attempt"
)


def main() -> int:
    """Print a row for each start; return 1 if a frame was late or an engagement failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100, metavar="N", help="engagements (default: 100)")
    parser.add_argument(
        "--each", type=int, default=5, metavar="N", help="of them with each start of all processes (default: 5)"
    )
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="busy processes beside (default: none)")
    parser.add_argument(
        "--attempts", type=int, default=3, metavar="N",
        help="how often at most a start is measured in which the machine stood still (default: 3)",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="PATH", help="where to write all figures; - for standard output")
    arguments = parser.parse_args()
    if min(arguments.count, arguments.each, arguments.attempts) < 1 or arguments.busy < 0:
        parser.error("--count, --each, --attempts: must be 1 or more, --busy 0 or more")
    out = sys.stderr if arguments.json is not None and str(arguments.json) == "-" else sys.stdout
    print(HEADINGS, file=out, flush=True)
    result = measured(
        arguments.count,
        arguments.each,
        arguments.busy,
        arguments.attempts,
        lambda row: print(row, file=out, flush=True),
    )
    for side in ("master", "slave"):
        figures = result[side]
        print(
            f"{side:6} {figures['engaged']} engagements, {figures['with_late_frames']} with late frames, "
            f"{figures['held']} of them held; loop late by {figures['wakes_late_median_ms']:.2f} ms (median), "
            f"{figures['wakes_late_max_ms']:.2f} ms (most)",
            file=out,
        )
    print(
        f"{'good' if result['good'] else 'NOT GOOD'}: {result['starts']} starts in {result['elapsed_s']:.0f} s beside "
        f"{result['busy']} busy processes, {result['measured_anew']} measured anew because the machine stood still, "
        f"{result['stolen_s']:.2f} s stolen by the host",
        file=out,
        flush=True,
    )
    if arguments.json is not None:
        text = json.dumps(result, indent=2)
        if str(arguments.json) == "-":
            print(text)
        else:
            arguments.json.parent.mkdir(parents=True, exist_ok=True)
            arguments.json.write_text(text + "\n", encoding="utf-8")
    return 0 if result["good"] else 1


if __name__ == "__main__":
    sys.exit(main())
