"""How fast is a hand thrown that lets go under a remote push, over the delay of the link?

    python examples/push_over_delay.py --controllers none hsc wsc --delays-ms 5 20 50

Runs the endpoints of the live bridge in virtual time: a hand presses a remote wall, something shoves the remote arm,
the hand lets go.
"""

import argparse
from typing import Literal, get_args

from haptether.bridge import (
    ContactTable,
    EnvironmentTable,
    LegTable,
    LinksTable,
    MasterTable,
    ObjectTable,
    OperatorTable,
    PusherTable,
    RecordTable,
    ReleaseTable,
    RunTable,
    SafetyTable,
    Scene,
    SlaveTable,
    simulate,
)
from haptether.netsim import LinkSettings

RELEASE_S = 2.6
Controller = Literal["none", "vfc", "hsc", "wsc"]


def thrown_at(controller: Controller, delay_s: float) -> float:
    """Largest speed in m/s away from the wall after the release."""
    wall = ObjectTable(contact=ContactTable(stiffness=100.0))
    push = PusherTable(shape="ramp", at_s=2.0, force_n=3.5, duration_s=2.0, rise_s=0.1)
    link = LinkSettings(delay_s=delay_s, jitter_s=delay_s / 10.0, loss=0.01)
    scene = Scene(
        schema=1,
        run=RunTable(duration_s=3.6, seed=1),
        master=MasterTable(device="phantom-desktop", stops=(-0.08, 0.08)),
        operator=OperatorTable(
            stiffness=300.0,
            damping=8.0,
            grip_strength_n=12.0,
            start=0.02,
            legs=(LegTable(duration_s=1.2, end=-0.045),),
            release=ReleaseTable(at_s=RELEASE_S, decay_s=0.05),
            clutch="once",
        ),
        slave=SlaveTable(),
        environment=EnvironmentTable(objects=(wall,), pushers=(push,)),
        link=LinksTable(forward=link, backward=link),
        safety=SafetyTable(controllers=() if controller == "none" else (controller,)),
        record=RecordTable(),
    )
    signals = simulate(scene).signals
    return float(signals.velocity[signals.time_s >= RELEASE_S].max())


def main() -> None:
    """Print one row per delay."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--controllers", nargs="+", choices=get_args(Controller), default=get_args(Controller))
    parser.add_argument("--delays-ms", nargs="+", type=float, default=[1.0, 10.0, 50.0, 100.0])
    arguments = parser.parse_args()
    print("one-way delay [ms]" + "".join(f"{name:>10}" for name in arguments.controllers))
    for delay_ms in arguments.delays_ms:
        speeds = [thrown_at(name, delay_ms * 1e-3) for name in arguments.controllers]
        print(f"{delay_ms:18g}" + "".join(f"{speed:10.3f}" for speed in speeds) + "  m/s")


if __name__ == "__main__":
    main()
