"""Both sides in virtual time."""

from haptether import _core
from haptether._core import LoopReport, MasterSettings, MasterTrace, SlaveSettings, SlaveTrace
from haptether.netsim import LinkSettings, link_json


def run_bridge(
    master: MasterSettings,
    slave: SlaveSettings,
    *,
    forward: LinkSettings,
    backward: LinkSettings,
    duration_s: float,
    seed: int = 0,
    secure: bool = False,
) -> tuple[MasterTrace, SlaveTrace, LoopReport, LoopReport]:
    """Runs both sides and the network between them in virtual time: no socket, no sleep, no clock.

    A frame without delay reaches the slave in the same tick and the master in the next. The same
    arguments give the same bytes.

    Args:
        master: The side of the hand.
        slave: The side of the robot, with the same period.
        forward: Network from master to slave.
        backward: Network from slave to master.
        duration_s: Length of the run in s.
        seed: Key of all draws, 0 to 2⁶⁴ - 1.
        secure: Whether frames travel in a secure session, which begins with a handshake.

    Returns:
        Ticks of the master and of the slave, and how the loop of each went.

    Raises:
        LinkError: Settings that describe no link.
        ValueError: Different periods, or a duration outside 0 to 1e9 s.
    """
    return _core.run_bridge(
        master,
        slave,
        forward=link_json(forward, "forward"),
        backward=link_json(backward, "backward"),
        duration_s=duration_s,
        seed=seed,
        secure=secure,
    )
