"""A console page that reads two loops at 1 kHz for minutes: browser, server and loops must not grow.

It fails unless the pair was coupled all the time, because a resting loop proves little.

python -m tests.soak.console --minutes 10
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from tests.view.console.browser import chromium, hold

if TYPE_CHECKING:
    from playwright.sync_api import CDPSession

WARM_UP_S = 60.0
"""Time in s until caches are filled: fonts, charts, the first garbage collections."""


def children(pid: int) -> list[int]:
    """Return a process and all its descendants."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found += children(int(child))
    return found


def proportional_mib(pids: list[int]) -> float:
    """Return the memory in MiB; shared memory is counted proportionally."""
    total = 0
    for pid in pids:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines():
            if line.startswith("Pss:"):
                total += int(line.split()[1])
    return total / 1024


def command(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")


class Memory:
    """Memory of console, browser and sides."""

    def __init__(self, console: int, browser: list[int], session: "CDPSession") -> None:
        self.console = console
        self.browser = browser
        self.session = session

    def now(self) -> dict[str, float]:
        """Return the current memory in MiB."""
        self.session.send("HeapProfiler.collectGarbage")
        metrics = {one["name"]: one["value"] for one in self.session.send("Performance.getMetrics")["metrics"]}
        sides = {
            name: [pid for pid in children(self.console)[1:] if f"haptether {name} " in command(pid)]
            for name in ("master", "slave")
        }
        return {
            "browser, all processes": proportional_mib(self.browser),
            "page, script heap": metrics["JSHeapUsedSize"] / 2**20,
            "server": proportional_mib([self.console]),
            **{f"loop of the {name}": proportional_mib(pids) for name, pids in sides.items()},
        }


COUPLED = """() => {
    const watch = window.coupled = { begun: performance.now(), until: null };
    setInterval(() => {
        const sides = ['master', 'slave'].map(side => document.querySelector(`#side-${side} .headline .engaged`));
        if (watch.until === null && !sides.every(Boolean)) watch.until = performance.now();
    }, 50);
}"""
"""Watches the page from now on, and notes when one of the two was first not engaged."""
STATE = """() => ({ coupled_s: ((coupled.until ?? performance.now()) - coupled.begun) / 1e3,
    to_the_end: coupled.until === null })"""


def main() -> int:
    """Print the memory at begin and end, and how long the pair was coupled; return 1 unless it was to the end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    minutes: float = parser.parse_args().minutes
    with subprocess.Popen(
        [sys.executable, "-m", "haptether", "console", "--scene", "remote_push"], stdout=subprocess.PIPE, text=True
    ) as console:
        assert console.stdout is not None
        address = console.stdout.readline().split()[-1]
        before = set(children(console.pid))
        with chromium() as browser:
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.goto(address)
            page.wait_for_selector("#side-master .headline")
            hold(page, 1.3)
            page.wait_for_selector("#side-master .headline .engaged")
            page.wait_for_selector("#side-slave .headline .engaged")
            page.evaluate(COUPLED)
            own = [pid for pid in children(os.getpid()) if pid not in before and "chromium" in command(pid)]
            session = page.context.new_cdp_session(page)
            session.send("Performance.enable")
            memory = Memory(console.pid, own, session)
            page.wait_for_timeout(WARM_UP_S * 1e3)
            begin, begun_s = memory.now(), time.monotonic()
            print(f"{'MiB':28}{'begin':>10}", flush=True)
            for name, value in begin.items():
                print(f"{name:28}{value:10.1f}", flush=True)
            page.wait_for_timeout(minutes * 60e3)
            end, took_s = memory.now(), time.monotonic() - begun_s
            print(f"\n{'MiB':28}{'begin':>10}{'end':>10}{'change':>10}   after {took_s / 60:.1f} min")
            for name, value in end.items():
                print(f"{name:28}{begin[name]:10.1f}{value:10.1f}{value - begin[name]:+10.1f}")
            print("page:", page.inner_text("#side-master .headline"), page.inner_text("#link") or "no row was lost")
            state = page.evaluate(STATE)
            end_of = "to the end" if state["to_the_end"] else "NOT to the end"
            print(f"coupled for {state['coupled_s']:.1f} s, {end_of}")
            for side in ("master", "slave"):
                causes = page.locator(f"#side-{side} .cause").all_inner_texts()
                print(f"{side}: {page.inner_text(f'#side-{side} .headline')}", *causes)
        console.terminate()
    return 0 if state["to_the_end"] else 1


if __name__ == "__main__":
    sys.exit(main())
