"""The address of a master: no wider than the route to its peer needs."""

import secrets
import socket

import pytest
from tests.scene.two_sides import two_sides

from haptether.bridge import LiveMaster, scene_json

pytestmark = pytest.mark.live

SCENE = scene_json(two_sides())


def listens(peer: str, listen: str | None = None) -> str:
    """Return the host that a master listens on."""
    master = LiveMaster(SCENE, peer=peer, listen=listen, run_id=secrets.randbits(64), insecure=True, realtime="off")
    address = master.address
    master.finish()
    return address.rpartition(":")[0]


@pytest.mark.parametrize(
    ("peer", "listen", "expected"),
    [
        ("127.0.0.1:9", None, "127.0.0.1"),
        ("[::1]:9", None, "[::1]"),
        ("127.0.0.1:9", "0.0.0.0:0", "0.0.0.0"),
        ("127.0.0.1:9", "127.0.0.2:0", "127.0.0.2"),
    ],
)
def test_a_peer_on_this_machine_is_talked_to_on_loopback(peer: str, listen: str | None, expected: str) -> None:
    if peer.startswith("["):
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("::1", 0))
            except OSError:
                pytest.skip("this machine has no IPv6")
    assert listens(peer, listen) == expected


def test_a_name_of_this_machine_is_talked_to_on_loopback() -> None:
    assert listens("localhost:9") in {"127.0.0.1", "[::1]"}


def test_a_peer_elsewhere_is_talked_to_from_the_address_of_its_route() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
        try:
            route.connect(("192.0.2.7", 9))
        except OSError:
            with pytest.raises(OSError, match="no way there"):
                listens("192.0.2.7:9")
            return
        assert listens("192.0.2.7:9") == route.getsockname()[0]
