"""Drives an arm of your own: a class with five methods, here a spring in front of a wall, against a simulated hand.

A package declares such a class as an entry point of the group `haptether.slaves` (a haptic device: of
`haptether.masters`); a scene then names it, `[slave] device = "..."`, and `haptether slave --scene` drives it.
"""

import argparse
import secrets

from haptether.bridge import LiveMaster, SlaveLoop, SlaveRun, load_scene, scene_json
from haptether.slave import SlaveSample

WALL = 100.0
"""In N/m."""


class SpringArm:
    """Is where it was commanded to be, on an arm so stiff that nothing bends it."""

    paces = False  # `read` does not wait for a sample: the loop keeps the time

    def __init__(self) -> None:
        """The arm rests 2 cm in front of the wall, which fills x < 0."""
        self.position, self.velocity = 0.02, 0.0

    def open(self) -> None:
        """Would connect."""

    def read(self) -> SlaveSample:
        """Position in m, velocity in m/s, and the force of the wall on the tool in N."""
        return SlaveSample(self.position, self.velocity, max(0.0, -WALL * self.position))

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        """Goes there."""
        self.position, self.velocity = position[0], velocity[0]

    def stop(self) -> None:
        """Stays where it is."""
        self.velocity = 0.0

    def close(self) -> None:
        """Would disconnect."""


def main() -> None:
    """Two seconds of a hand that presses the wall through the arm."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    scene = scene_json(load_scene("remote_push", ["link.forward={}", "link.backward={}"]))
    key = secrets.token_bytes(32)
    loop = SlaveLoop(scene, listen="127.0.0.1:0", run_id=secrets.randbits(64), key=key)
    slave = SlaveRun(SpringArm(), loop)
    master = LiveMaster(scene, peer=loop.address, run_id=secrets.randbits(64), key=key, duration_s=2.0, patience_s=10.0)
    while not (master.finished or slave.finished):
        slave.poll()
        master.poll()
    felt, report = master.finish()
    done, _ = slave.finish()
    if slave.error is not None:
        raise slave.error
    print(f"{report.ticks} ticks, {report.holds} holds; the arm went to {done.position.min() * 1e3:.1f} mm")
    print(f"the wall pushed with {done.environment_force.max():.2f} N, the hand felt {felt.device_force.max():.2f} N")


if __name__ == "__main__":
    main()
