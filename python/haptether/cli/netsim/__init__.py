"""`haptether netsim`: its commands."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Netsim:
    """Impair a network: live between two processes, or as a table with the fate of each packet.

    Delay with jitter that keeps the order, loss in bursts, outages, a bottleneck with a queue, reordering, copies,
    damage, recordings, presets of measured networks. The same seed treats the same packets alike, live and in virtual
    time. A real network can be measured and replayed. Each command has help of its own.

    Examples:

    haptether netsim list

    haptether netsim sample --delay-s 0.05 --jitter-s 0.005 --loss 0.01 --mean-burst 5 --packets 100000

    haptether netsim proxy --listen 127.0.0.1:9001 --forward 127.0.0.1:9000 --preset lte-driving
    """
