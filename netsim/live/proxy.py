"""The live proxy."""

from collections.abc import Sequence
from os import PathLike
from typing import Literal

from haptether import _core
from haptether._core import ProxyStatistics
from haptether.netsim.link.resolve import link_json
from haptether.netsim.link.settings import LinkSettings


class Proxy:
    """A live UDP proxy between clients and one peer, which does to their datagrams what the links say.

    It runs on its own thread, forwards to the peer only, and serves clients of this machine and those that
    `allow` names, up to 64 at a time. All share the link of their direction.

    Args:
        listen: Where the clients send to, `HOST:PORT`; port 0 lets the system choose.
        forward: The peer, `HOST:PORT`.
        forward_link: Network from the client to the peer.
        backward_link: Network from the peer to the client.
        seed: Key of all draws, 0 to 2⁶⁴ - 1.
        allow: Sources that are served beside those of this machine, `IP` or `IP:PORT`.
        realtime: Whether to request real-time scheduling; the statistics say what was granted.
        max_error_s: Largest p99 of its scheduling error in s with which a run is valid.
        log: CSV file for what became of each datagram.

    Raises:
        LinkError: Settings that describe no link.
        ValueError: An address that is none.
        OSError: An address that cannot be used.
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
        """Where it listens, with the port that was chosen."""
        return self._proxy.address

    @property
    def forward(self) -> str:
        """Address to which it forwards: the first of a name to which it can send."""
        return self._proxy.forward

    @property
    def finished(self) -> bool:
        """Whether its thread has ended."""
        return self._proxy.finished

    def change(self, direction: Literal["forward", "backward"], settings: LinkSettings) -> None:
        """Other settings for the datagrams that come from now on; taken up within 20 ms, in order.

        Raises:
            LinkError: Settings that describe no link.
            ValueError: No such `direction`.
        """
        self._proxy.change(direction, link_json(settings, direction))

    def statistics(self) -> ProxyStatistics:
        """What it has done so far, while it goes on."""
        return self._proxy.statistics()

    def stop(self) -> ProxyStatistics:
        """Ends it, which takes up to 20 ms; what is still in flight is not sent.

        Raises:
            OSError: The proxy had ended on an error of its sockets.
            RuntimeError: Its thread panicked.
        """
        return self._proxy.stop()
