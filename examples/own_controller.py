"""A safety controller of your own, in Python, beside those that come with Haptether: a run, a sweep, an evaluation.

A package names such a class by an entry point of the group `haptether.controllers`; then scenes and `haptether evaluate
--controller none wsc speed-brake` have it by that name, as those of this process have it by `register_controller`.
"""

import argparse

import numpy as np
import numpy.typing as npt

from haptether.bridge import controller_time, register_controller, simulate, sweep
from haptether.safety import ResearchObservation
from haptether.studies import evaluate


class SpeedBrake:
    """Takes the force away and damps as long as the device is pushed faster than a hand goes by itself.

    Args:
        limit: In m/s.
        damping: mu in N s/m.
    """

    def __init__(self, limit: float = 0.35, damping: float = 4.0) -> None:
        """Has seen nothing."""
        self.limit, self.damping = limit, damping
        self.until_rest = False

    def step(self, seen: ResearchObservation) -> npt.NDArray[np.float64] | None:
        """F_c = -F_v - mu V from when the device is too fast until it rests; else none."""
        speed = float(np.linalg.norm(seen.velocity))
        pushed = float(seen.rendered_force @ seen.velocity) > 0.0
        self.until_rest = speed > 0.02 if self.until_rest else pushed and speed > self.limit
        return -seen.rendered_force - self.damping * seen.velocity if self.until_rest else None


def main() -> None:
    """Compare it with the windowed energy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    register_controller("speed-brake", SpeedBrake)

    ours = ["safety.controllers=[]", 'safety.research.controller="speed-brake"']
    for name, overrides in (
        ("nobody", ["safety.controllers=[]"]),
        ("wsc", ["safety.controllers=[wsc]"]),
        ("ours", ours),
    ):
        metrics = simulate("paper_wall", overrides=overrides).metrics
        print(f"{name}: largest speed after the release {metrics.max_ejection_velocity:.3f} m/s")

    limits = [0.2, 0.35, 0.5]
    rows = sweep(
        "paper_wall", {"safety.research.options.limit": limits}, overrides=[*ours, "safety.research.options.limit=1"]
    )
    for limit, speed in zip(limits, rows["max_ejection_velocity"], strict=True):
        print(f"limit {limit} m/s: {speed:.3f} m/s")

    found = evaluate(
        ["paper_wall"], controllers=["none", "wsc", "speed-brake"], round_trips_s=[0.0], hands=2, releases=2
    )
    for cell in found.cells:
        print(f"{cell.controllers}: {cell.thrown} of {cell.dangerous} dangerous releases thrown")
    taken = controller_time()
    print(f"in Python: {taken.ticks} ticks of {1e6 * taken.seconds / taken.ticks:.1f} us each")


if __name__ == "__main__":
    main()
