"""Picks something up with a Robotiq gripper: an emulated one, or with --host a real one on the URCap of a UR arm.

A gripper that was not activated since its power came must open and close its jaws once. That is asked first.
"""

import argparse
import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

from haptether.slave import GripperCommand, GripperSample, RobotiqGripper

EMULATED = "127.63.35.1"
PATIENCE_S = 10.0


@contextlib.contextmanager
def emulated() -> Iterator[str]:
    """The address of an emulated controller, whose gripper has 40 mm between its jaws."""
    command = ["ur-emulator", "--host", EMULATED, "--gripper", "2f-85", "--gripper-object-mm", "40"]
    process = subprocess.Popen([sys.executable, "-P", "-m", "haptether", *command], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        print(process.stdout.readline(), end="")
        yield EMULATED
    finally:
        process.terminate()
        process.communicate()


def until(gripper: RobotiqGripper, holds: Callable[[GripperSample], bool]) -> GripperSample:
    """The first sample of which something holds."""
    end_s = time.monotonic() + PATIENCE_S
    while not holds(sample := gripper.read()):
        if sample.fault is not None or time.monotonic() > end_s:
            sys.exit(f"given up: {sample}")
        time.sleep(0.01)
    return sample


def pick(gripper: RobotiqGripper) -> None:
    """Closes on what is there, holds it for a second and lets go."""
    gripper.open()
    try:
        gripper.write(GripperCommand(position=1.0, speed=0.5, force_n=30.0))
        sample = until(gripper, lambda sample: sample.holds_object or sample.position == 1.0)
        print(f"{'holds something' if sample.holds_object else 'met nothing'} at {100.0 * sample.position:.0f} %")
        gripper.hold()  # what is held stays held; without this line as well
        time.sleep(1.0)
        gripper.write(GripperCommand(position=0.0, speed=0.5, force_n=30.0))
        until(gripper, lambda sample: sample.position == 0.0)
        print(f"open; a reply took {1e3 * gripper.round_trip_s:.1f} ms")
    finally:
        gripper.close()


def main() -> None:
    """Closes, holds, opens."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--host", help="address of a real UR controller")
    parser.add_argument("--model", default="2f-85", help="2f-85, 2f-140 or hand-e")
    arguments = parser.parse_args()
    if arguments.host is None:
        with emulated() as host:
            pick(RobotiqGripper(host=host, activate=True))
        return
    print("The jaws will close and open, and twice if the gripper is not active yet.")
    if input("Hands and parts out of them, and somebody at the emergency stop? Type yes: ") != "yes":
        sys.exit("not moved")
    pick(RobotiqGripper(host=arguments.host, model=arguments.model, activate=True))


if __name__ == "__main__":
    main()
