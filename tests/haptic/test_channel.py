"""Isolation of the loop from a service: it cannot block the loop, and brakes of other devices do not count."""

import base64
import contextlib
import hashlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from tests.haptic.emulated import EmulatedInverse, emulated_service
from tests.ur.stalls import anew_after_stalls

from haptether.checklist import RefusedError
from haptether.master.inverse3 import Inverse3
from haptether.master.inverse3.channel import Channel, ChannelError
from haptether.master.inverse3.checks import MAX_EVENTS, brake, event_fault, pending_events
from haptether.master.inverse3.messages import event

pytestmark = pytest.mark.live

GUID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
PATIENT_S = 2.0
"""Patience in s for a call that may take 10 ms, on a loaded test machine."""


def text_frame(message: bytes, first: int = 0x81) -> bytes:
    """Return a WebSocket frame of a server, of less than 64 KiB. Source: RFC 6455, section 5.2."""
    size = len(message)
    length = bytes((size,)) if size < 126 else b"\x7e" + size.to_bytes(2, "big")
    return bytes((first,)) + length + message


@contextmanager
def flooding(sent: bytes, first: bytes = b"") -> Iterator[Channel]:
    """Yield a channel to a server that sends the same bytes as fast as it can."""
    listener = socket.create_server(("127.0.0.1", 0))
    over = threading.Event()

    def serve() -> None:
        client, _ = listener.accept()
        with client:
            request = b""
            while b"\r\n\r\n" not in request:
                request += client.recv(4096)
            key = next(line for line in request.split(b"\r\n") if line.lower().startswith(b"sec-websocket-key:"))
            accept = base64.b64encode(hashlib.sha1(key.split(b":", 1)[1].strip() + GUID).digest())
            client.sendall(
                b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Accept: " + accept + b"\r\n\r\n" + first
            )
            client.settimeout(0.2)
            block = sent * max(1, 65536 // len(sent))
            with contextlib.suppress(OSError):
                while not over.is_set():
                    with contextlib.suppress(TimeoutError):
                        client.sendall(block)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    channel = Channel(*listener.getsockname()[:2])
    try:
        yield channel
    finally:
        over.set()
        channel.close()
        thread.join(5.0)
        listener.close()


def returns_within(seconds: float, call: "threading.Thread") -> None:
    call.start()
    call.join(seconds)
    assert not call.is_alive(), "it is held up"


@pytest.mark.parametrize(
    ("first", "sent"),
    [
        (b"", text_frame(b"", 0x89)),  # pings
        (b"", text_frame(b"", 0x8A)),  # unrequested answers to pings
        (text_frame(b"", 0x01), text_frame(b"", 0x00)),  # parts of a message that never ends
    ],
    ids=["pings", "pongs", "parts"],
)
@pytest.mark.parametrize("limit_s", [0.0, 0.01])
@anew_after_stalls
def test_a_wait_for_a_frame_ends_whatever_else_arrives(first: bytes, sent: bytes, limit_s: float) -> None:
    with flooding(sent, first) as channel:
        found: list[object] = []

        def wait() -> None:
            try:
                found.append(channel.frame(limit_s))
            except ChannelError as error:
                found.append(error)

        returns_within(PATIENT_S, threading.Thread(target=wait, daemon=True))
        assert found == [None] or isinstance(found[0], ChannelError)


@pytest.mark.parametrize("first", [0x89, 0x8A], ids=["pings", "pongs"])
@anew_after_stalls
def test_a_call_that_does_not_wait_takes_no_more_than_a_few_kilobytes(
    monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    """64 KiB of these frames are 32768 frames: half a second on a busy machine."""
    with flooding(text_frame(b"", first)) as channel:
        time.sleep(0.1)
        taken: list[int] = []
        receive = channel._protocol.receive_data

        def counted(received: bytes | bytearray) -> None:
            taken.append(len(received))
            receive(received)

        monkeypatch.setattr(channel._protocol, "receive_data", counted)
        shortest_s = 10.0
        for _ in range(5):
            taken.clear()
            begun_s = time.monotonic()
            with contextlib.suppress(ChannelError):
                channel.frame(0.0)
            shortest_s = min(shortest_s, time.monotonic() - begun_s)
            assert sum(taken) <= 8192
        assert shortest_s < 0.1


def test_a_flood_of_events_ends_the_connection() -> None:
    with flooding(text_frame(b'{"name":"device-battery-low"}')) as channel:
        time.sleep(0.1)
        said: list[str] = []

        def hear() -> None:
            try:
                while True:
                    pending_events(channel)
            except ChannelError as error:
                said.append(str(error))

        returns_within(PATIENT_S, threading.Thread(target=hear, daemon=True))
        assert said == [f"more than {MAX_EVENTS} events at once"]


# ------------------------------------------------------------------------------------------------- what events name


def trip(name: str, device_id: object) -> bytes:
    return json.dumps(
        {"name": "device-safety-triggered", "data": {"safety_type": name, "device_id": device_id}}
    ).encode()


@pytest.mark.parametrize("strange", [[], {}, 7, True, None])
def test_what_is_no_name_is_no_exception(strange: object) -> None:
    happened = event(json.dumps({"name": "device-safety-triggered", "data": {"safety_type": strange}}).encode())
    assert "safety stop" in (event_fault(happened, "049D", None) or "")
    assert brake(happened, "049D") is None
    # An event without a device may be about ours; it is not about a grip, because there is none.
    of_any = event_fault(event(trip("stall_detected", strange)), "049D", None)
    assert (of_any is not None) is (strange is None)
    gone = event(json.dumps({"name": "device-disconnected", "data": {"device_id": None}}).encode())
    assert (event_fault(gone, "049D", None) or "").startswith("device disconnected")


@pytest.mark.parametrize(
    ("name", "device_id", "is_on"),
    [
        ("ebrake_triggered", "049D", True),
        ("ebrake_released", "049D", False),
        ("ebrake_released", None, False),
        ("ebrake_triggered", "other", None),
        ("ebrake_released", "other", None),
        ("stall_detected", "049D", None),
    ],
)
def test_a_brake_is_that_of_our_device(name: str, device_id: object, is_on: bool | None) -> None:
    assert brake(event(trip(name, device_id)), "049D") is is_on


def test_the_release_of_another_brake_is_not_that_of_ours(
    service: EmulatedInverse, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = Inverse3(**service.options)
    driver.open()
    try:
        service.do("ebrake on")
        end_s = time.monotonic() + 10.0
        while driver.read().fault is None:
            driver.write((0.0, 0.0, 0.0))
            assert time.monotonic() < end_s
        other = event(trip("ebrake_released", "other"))
        monkeypatch.setattr("haptether.master.inverse3.driver.pending_events", lambda _events: [other])
        driver.acknowledge()
        driver.write((0.0, 0.0, 0.0))
        assert "still on" in (driver.read().fault or "")
    finally:
        driver.close()


# ------------------------------------------------------------------------------------------------- lives of a driver


@pytest.fixture
def service() -> Iterator[EmulatedInverse]:
    with emulated_service() as running:
        yield running


@anew_after_stalls
def test_it_is_opened_once_and_anew_after_its_end(service: EmulatedInverse) -> None:
    driver = Inverse3(**service.options)
    driver.open()
    with pytest.raises(ValueError, match="is open"):
        driver.open()
    assert driver.read().fault is None
    service.do("ebrake on")
    end_s = time.monotonic() + 10.0
    while driver.read().fault is None:
        driver.write((0.0, 0.0, 0.0))
        assert time.monotonic() < end_s
    driver.close()
    service.do("ebrake off")
    driver.open()
    try:
        # The release was not received: the brake counts as on until a release is.
        assert "was when it was last heard of" in (driver.read().fault or "")
        service.do("ebrake on")
        service.do("ebrake off")
        # An acknowledgement before the release is received is repeated.
        while driver.read().fault is not None:
            driver.write((0.0, 0.0, 0.0))
            driver.acknowledge()
            assert time.monotonic() < end_s
    finally:
        driver.close()
    service.wait_for("clients", 0)


def test_a_driver_that_is_closed_while_it_opens_has_no_connection(
    service: EmulatedInverse, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = Inverse3(**service.options)
    connected = driver._connected

    def slow(checklist: object) -> object:
        session = connected(checklist)  # type: ignore[arg-type]
        driver.close()
        return session

    monkeypatch.setattr(driver, "_connected", slow)
    with pytest.raises(RefusedError, match="closed before it was open"):
        driver.open()
    assert driver.read().fault is not None
    service.wait_for("clients", 0)


def test_a_reconnection_that_comes_after_the_close_is_closed(
    service: EmulatedInverse, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("haptether.master.inverse3.driver.JOIN_S", 0.1)
    driver = Inverse3(**service.options)
    driver.open()
    connected = driver._connected
    closed, entered = threading.Event(), threading.Event()

    def late(checklist: object) -> object:
        session = connected(checklist)  # type: ignore[arg-type]
        entered.set()
        assert closed.wait(20.0)
        return session

    service.do("disconnect")
    end_s = time.monotonic() + 20.0
    while driver.read().fault is None:
        driver.write((0.0, 0.0, 0.0))
        assert time.monotonic() < end_s
    monkeypatch.setattr(driver, "_connected", late)
    driver.acknowledge()
    assert entered.wait(20.0)
    driver.close()
    closed.set()
    service.wait_for("clients", 0)
    assert "connected anew" not in (driver.read().fault or "")


def test_a_reconnection_that_fails_in_any_way_can_be_tried_again(
    service: EmulatedInverse, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = Inverse3(**service.options)
    driver.open()
    try:
        driver.read()
        service.do("disconnect")
        end_s = time.monotonic() + 10.0
        while driver.read().fault is None:
            driver.write((0.0, 0.0, 0.0))
            assert time.monotonic() < end_s
        with monkeypatch.context() as broken:

            def fails(_checklist: object) -> None:
                message = "of a library"
                raise ValueError(message)

            broken.setattr(driver, "_connected", fails)
            driver.acknowledge()
            while "of a library" not in (driver.read().fault or ""):
                time.sleep(0.01)
                assert time.monotonic() < end_s
        while driver.read().fault is not None:
            driver.acknowledge()
            time.sleep(0.01)
            assert time.monotonic() < end_s
    finally:
        driver.close()


def test_a_whole_number_beyond_all_floats_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^driver = inverse3: port = 1000.*: must be finite$"):
        Inverse3(port=10**400)
