"""Live proxy."""

from collections.abc import Sequence
from os import PathLike
from typing import Literal

from haptether import _core
from haptether._core import ProxyStatistics
from haptether.netsim.link.resolve import link_json
from haptether.netsim.link.settings import LinkSettings


class Proxy:
    """Live UDP proxy between clients and one peer that applies the links to their datagrams.

    Runs on its own thread, forwards to the peer only, and serves up to 64 clients from this machine and `allow`. All
    clients share the link of their direction.

    Args:
        listen: Address for the clients, `HOST:PORT`; port 0 lets the system choose.
        forward: Address of the peer, `HOST:PORT`.
        forward_link: Network from the client to the peer.
        backward_link: Network from the peer to the client.
        seed: Seed of all draws, 0 to 2⁶⁴ - 1.
        allow: Allowed sources in addition to this machine, `IP` or `IP:PORT`.
        realtime: True to request real-time scheduling; the statistics report the result.
        max_error_s: Largest p99 scheduling error in s of a valid run.
        log: CSV file for the verdict of each datagram.

    Raises:
        LinkError: The settings are invalid.
        ValueError: An address is invalid.
        OSError: An address cannot be used.
    """

    def __init__(
        self,
        *,
        listen: str,
        forward: str,
        forward_link: LinkSettings,
        backward_link: LinkSettings,
        seed: int = 0,
        allow: Sequence[str] = (),
        realtime: bool = True,
        max_error_s: float = 1e-3,
        log: str | PathLike[str] | None = None,
    ) -> None:
        self._proxy = _core.Proxy(
            listen=listen,
            forward=forward,
            forward_link=link_json(forward_link, "forward"),
            backward_link=link_json(backward_link, "backward"),
            seed=seed,
            allow=allow,
            realtime=realtime,
            max_error_s=max_error_s,
            log=log,
        )

    @property
    def address(self) -> str:
        """Listening address, with the chosen port."""
        return self._proxy.address

    @property
    def forward(self) -> str:
        """Address of the peer: the first address of its name that is reachable."""
        return self._proxy.forward

    @property
    def finished(self) -> bool:
        """True if the thread has ended."""
        return self._proxy.finished

    def change(self, direction: Literal["forward", "backward"], settings: LinkSettings) -> None:
        """Apply other settings to datagrams from now on; takes effect within 20 ms, in order.

        Raises:
            LinkError: The settings are invalid.
            ValueError: The `direction` does not exist.
        """
        self._proxy.change(direction, link_json(settings, direction))

    def statistics(self) -> ProxyStatistics:
        """Return the statistics so far."""
        return self._proxy.statistics()

    def stop(self) -> ProxyStatistics:
        """Stop within 20 ms; datagrams in flight are dropped.

        Raises:
            OSError: The proxy ended on a socket error.
            RuntimeError: The thread panicked.
        """
        return self._proxy.stop()
