"""`haptether dynamixel find`."""

from dataclasses import dataclass
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Find:
    """Print which servos answer on a port, at every rate that they can have. Nothing is set.

    Examples:

    haptether dynamixel find /dev/ttyUSB0

    haptether dynamixel find /dev/ttyUSB0 --baud 1000000 --ids 1 2 3
    """

    port: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PORT")]
    """The serial port; also as --port PORT."""
    baud: int | None = None
    """Only this rate in bit/s; by default all rates."""
    ids: tuple[int, ...] = tuple(range(1, 21))
    """Ids to query."""

    def run(self) -> int:
        """Print a line per servo; return 1 if there is none."""
        from haptether.cli.dynamixel.search import found_servos

        servos = found_servos(self.port, self.baud, self.ids)
        for servo in servos:
            name = servo.model.name if servo.model is not None else f"model {servo.number}, which is not known"
            print(f"id {servo.servo_id}: {name}, firmware {servo.firmware}, {servo.baud} bit/s")
        if not servos:
            print("no servo answers: see supply, cables and --ids")
        return 0 if servos else 1
