"""The live proxy."""

from haptether import _core
from haptether._core import ProxyStatistics
from haptether.netsim.link_settings import LinkSettings
from haptether.netsim.link_spec import link_json


class Proxy:
    """A live UDP proxy between one client and one peer, which does to their datagrams what the links say.

    It runs on its own thread.

    Args:
        listen: Where the client sends to, `HOST:PORT`; port 0 lets the system choose.
        forward: The peer, `HOST:PORT`.
        forward_link: Network from the client to the peer.
        backward_link: Network from the peer to the client.
        seed: Key of all draws, 0 to 2⁶⁴ - 1.

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
    ) -> None:
        self._proxy = _core.Proxy(
            listen=listen,
            forward=forward,
            forward_link=link_json(forward_link, "forward"),
            backward_link=link_json(backward_link, "backward"),
            seed=seed,
        )

    @property
    def address(self) -> str:
        """Where it listens, with the port that was chosen."""
        return self._proxy.address

    @property
    def finished(self) -> bool:
        """Whether its thread has ended."""
        return self._proxy.finished

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
