"""Datagrams that are not from the peer: the side that gets them counts them and tells its operator."""

import secrets
import socket
import time
from collections.abc import Callable

import pytest
from tests.scene.two_sides import two_sides

from haptether.bridge import LiveMaster, LiveSlave, scene_json
from haptether.netsim import LinkSettings, Proxy, record

pytestmark = pytest.mark.live

SCENE = scene_json(two_sides())
PATIENCE_S = 10.0
KEYS = bytes(range(32)), bytes(range(1, 33))
ELSEWHERE = "datagram from another address than the peer's"


def told(side: LiveMaster | LiveSlave, what: str, again: Callable[[], object] = lambda: None) -> str:
    """Return the first event of a side with this text."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        again()
        for event in side.security_events():
            if what in event:
                return event
        time.sleep(0.005)
    pytest.fail(f"nothing was said of {what!r}")


def slave(key: bytes | None) -> LiveSlave:
    return LiveSlave(SCENE, listen="127.0.0.1:0", run_id=1, key=key, insecure=key is None, realtime="off")


def master(peer: str, key: bytes | None) -> LiveMaster:
    run = secrets.randbits(64)
    return LiveMaster(SCENE, peer=peer, run_id=run, key=key, insecure=key is None, realtime="off")


@pytest.mark.parametrize(
    ("of_slave", "of_master", "what", "remedy"),
    [
        (KEYS[0], KEYS[1], "of another key", "both sides must have the same key file"),
        (KEYS[0], None, "in the clear", "this side has a key: give --key there, too"),
        (None, KEYS[0], "encrypted", "this side has no key: give --key here, too"),
    ],
)
def test_a_master_that_this_slave_does_not_understand(
    of_slave: bytes | None, of_master: bytes | None, what: str, remedy: str
) -> None:
    here = slave(of_slave)
    there = master(here.address, of_master)
    event = told(here, what)
    assert event.startswith("ignored: 1 datagram ")
    assert f"the last from {there.address}" in event
    assert remedy in event
    there.finish()
    _, report = here.finish()
    assert sum(report.rejections.values()) >= 1
    assert report.link.fresh == 0


@pytest.mark.parametrize("key", [None, KEYS[0]])
def test_another_version(key: bytes | None) -> None:
    here = slave(key)
    host, port = here.address.split(":")
    magic = b"HT" if key is None else b"HS"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        event = told(
            here, "of another version", lambda: other.sendto(magic + bytes((99, 1)) + bytes(60), (host, int(port)))
        )
    assert "install the same Haptether on both sides" in event
    here.finish()


def test_who_is_not_the_peer_is_counted_at_the_master() -> None:
    here = slave(None)
    there = master(here.address, None)
    host, port = there.address.split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        event = told(there, "another address", lambda: other.sendto(b"hello", (host, int(port))))
        assert f"from 127.0.0.1:{other.getsockname()[1]}" in event
    _, report = there.finish()
    here.finish()
    assert report.rejections[ELSEWHERE] >= 1
    assert report.link.refused >= report.rejections[ELSEWHERE]


@pytest.mark.parametrize(
    ("peer", "why"),
    [
        ("0.0.0.0:9000", "every address of the machine that listens"),
        ("[::]:9000", "every address of the machine that listens"),
        ("255.255.255.255:9000", "many machines"),
        ("[ff02::1%lo]:9000", "many machines"),
        ("127.0.0.1:0", "must name a port from 1 to 65535"),
        ("[fe80::1]:9000", "name one behind a %, as in .fe80::1%eth0.:9000"),
        ("[fe80::1%nowhere]:9000", 'no network interface "nowhere"'),
    ],
)
def test_a_peer_that_cannot_answer_is_refused(peer: str, why: str) -> None:
    perfect = LinkSettings()
    for start in (
        lambda: master(peer, None),
        lambda: record(peer, rate_hz=10.0, duration_s=0.1),
        lambda: Proxy(listen="127.0.0.1:0", forward=peer, forward_link=perfect, backward_link=perfect),
    ):
        with pytest.raises(ValueError, match=why):
            start()
