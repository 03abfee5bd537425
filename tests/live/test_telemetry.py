"""Telemetry of a live loop: to readers that read, stall or go, and to other clients."""

import json
import secrets
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.live.sides import free_port
from tests.scene.two_sides import two_sides

from haptether.bridge import (
    LiveMaster,
    LiveSlave,
    TelemetryCause,
    TelemetryChange,
    TelemetryEnd,
    TelemetryMessage,
    TelemetryReader,
    TelemetrySample,
    ladder_state_name,
    scene_json,
)

pytestmark = pytest.mark.live


def read_all(path: Path, into: list[TelemetryMessage]) -> None:
    with TelemetryReader(path, timeout_s=30.0) as reader:
        into.extend(reader)


def samples(messages: list[TelemetryMessage]) -> list[TelemetrySample]:
    return [message for message in messages if isinstance(message, TelemetrySample)]


def changes(messages: list[TelemetryMessage], signal: str) -> list[tuple[object, object]]:
    found = (message for message in messages if isinstance(message, TelemetryChange))
    return [(change.from_, change.to) for change in found if change.signal == signal]


Readers = tuple[TelemetryReader, TelemetryReader]


@pytest.fixture
def sides(tmp_path: Path) -> Iterator[tuple[LiveMaster, LiveSlave, Readers]]:
    """Yield two sides that engage, with their readers; the slave has its reader before there is a master."""
    scene = scene_json(two_sides())
    paths = tmp_path / "master.sock", tmp_path / "slave.sock"
    slave = LiveSlave(
        scene, listen="127.0.0.1:0", run_id=secrets.randbits(64), insecure=True, patience_s=20.0, telemetry=paths[1]
    )
    of_slave = TelemetryReader(paths[1], timeout_s=30.0)
    master = LiveMaster(
        scene, peer=slave.address, run_id=secrets.randbits(64), insecure=True, duration_s=1.5, patience_s=20.0,
        telemetry=paths[0],
    )  # fmt: skip
    with of_slave, TelemetryReader(paths[0], timeout_s=30.0) as of_master:
        yield master, slave, (of_master, of_slave)
    for side in (master, slave):
        side.stop()
    assert not any(path.exists() for path in paths)


def test_both_sides_send_all_ticks_with_their_extremes_and_what_changes(
    sides: tuple[LiveMaster, LiveSlave, Readers],
) -> None:
    master, slave, pair = sides
    seen: tuple[list[TelemetryMessage], list[TelemetryMessage]] = ([], [])
    readers = [
        threading.Thread(target=messages.extend, args=(reader,)) for reader, messages in zip(pair, seen, strict=True)
    ]
    for reader in readers:
        reader.start()
    end_s = time.monotonic() + 60.0
    while not master.finished:
        time.sleep(0.01)
        assert time.monotonic() < end_s
    trace, report = master.finish()
    slave.stop()
    of_slave, slave_report = slave.finish()
    for reader in readers:
        reader.join(30.0)
    for messages, ticks in zip(seen, (trace, of_slave), strict=True):
        assert isinstance(messages[-1], TelemetryEnd)
        time_ns = np.rint(ticks.time_s * 1e9).astype(np.int64)
        assert samples(messages)[-1].time_ns == time_ns[-1]
        # Counted from the first sample, because earlier ticks may have passed before the reader came.
        first = samples(messages)[0]
        assert sum(sample.ticks for sample in samples(messages)[1:]) == np.count_nonzero(time_ns > first.time_ns)
        states = [ladder_state_name(int(code)) for code in ticks.state]
        changed = [
            (at, before, after)
            for at, before, after in zip(time_ns[1:], states, states[1:], strict=False)
            if before != after and at > first.time_ns
        ]
        assert [
            (change.time_ns, change.from_, change.to)
            for change in messages
            if isinstance(change, TelemetryChange) and change.signal == "state" and change.time_ns > first.time_ns
        ] == changed
    assert ("aligning", "engaged") in changes(seen[1], "state")
    assert report.dropped_records == slave_report.dropped_records == 0
    # Each sample is compared with the ticks that it stands for.
    first_ns = samples(seen[0])[0].time_ns
    time_ns = np.rint(trace.time_s * 1e9).astype(np.int64)
    begin = int(np.searchsorted(time_ns, first_ns, side="right"))
    for sample in samples(seen[0])[1:]:
        end = int(np.flatnonzero(time_ns == sample.time_ns)[0]) + 1
        ticks_of = trace.device_force[begin:end]
        assert len(ticks_of) == sample.ticks
        assert sample.signals["device_force"][0] == [ticks_of.min(), ticks_of.max(), ticks_of[-1]]
        begin = end


def test_a_cause_reaches_those_who_come_later(tmp_path: Path) -> None:
    path = tmp_path / "master.sock"
    scene = scene_json(two_sides())
    slave = LiveSlave(scene, listen="127.0.0.1:0", run_id=1, insecure=True, patience_s=20.0)
    master = LiveMaster(scene, peer=slave.address, run_id=2, insecure=True, patience_s=20.0, telemetry=path)
    end_s = time.monotonic() + 30.0
    try:
        while master.state != "engaged":
            time.sleep(0.01)
            assert time.monotonic() < end_s
        slave.stop()
        while master.cause() is None:
            time.sleep(0.01)
            assert time.monotonic() < end_s
        text = json.loads(master.cause() or "")["text"]
        # The cause was sent before this reader came.
        time.sleep(0.2)
        with TelemetryReader(path) as reader:
            first = next(iter(reader))
        assert isinstance(first, TelemetryCause)
        assert first.text == text
    finally:
        master.finish()
        slave.finish()


def test_a_reader_that_does_not_read_or_talks_holds_nothing_up(tmp_path: Path) -> None:
    path = tmp_path / "master.sock"
    scene = scene_json(two_sides())
    master = LiveMaster(scene, peer=f"127.0.0.1:{free_port()}", run_id=1, insecure=True, patience_s=2.0, telemetry=path)
    stalled = socket.socket(socket.AF_UNIX)
    stalled.connect(str(path))
    stalled.sendall(b'{"command": "stop"}\n' * 1000)
    messages: list[TelemetryMessage] = []
    read_all(path, messages)
    _, report = master.finish()
    stalled.close()
    assert isinstance(messages[-1], TelemetryEnd)
    assert samples(messages)[-1].dropped == 0
    # Bytes sent by the reader did not stop the side.
    assert report.ticks + report.skipped > 1900


def test_the_command_has_it_and_killed_it_leaves_a_socket_that_the_next_replaces(tmp_path: Path) -> None:
    path = tmp_path / "side.sock"
    command = [
        sys.executable, "-m", "haptether", "master", "--peer", f"127.0.0.1:{free_port()}", "--insecure",
        "--patience-s", "30", "--telemetry", str(path),
    ]  # fmt: skip

    def started() -> subprocess.Popen[bytes]:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end_s = time.monotonic() + 60.0
        while True:
            try:
                with TelemetryReader(path) as reader:
                    assert reader.hello.side == "master"
                    assert reader.hello.security == "insecure"
                    return process
            except (FileNotFoundError, ConnectionRefusedError):
                assert process.poll() is None
                assert time.monotonic() < end_s
                time.sleep(0.05)

    first = started()
    first.kill()
    first.wait(30)
    assert path.exists()
    second = started()
    third = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert third.returncode != 0
    assert "another run sends its telemetry there" in third.stderr
    second.terminate()
    assert second.wait(30) in (0, 130, 143)
    assert not path.exists()


@pytest.mark.parametrize(
    ("sent", "error", "said"),
    [
        (b"SSH-2.0\n", ValueError, "no line of telemetry"),
        (b'{"kind":"end","time_ns":1}\n', ValueError, "sends no telemetry"),
        (b"", ConnectionError, "closed before it said"),
        (b'{"kind":"refused","text":"16 programs"}\n', ConnectionError, "16 programs"),
        (
            b'{"kind":"hello","schema":2,"side":"master","security":"secure","signals":[]}\n',
            ValueError,
            "schema = 2, must be 1",
        ),
        (b"x" * (2 << 20), ValueError, "a line of more than"),
    ],
)
def test_what_is_no_telemetry_is_refused(sent: bytes, error: type[Exception], said: str, tmp_path: Path) -> None:
    path = tmp_path / "other.sock"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            client, _ = listener.accept()
            with client:
                try:
                    client.sendall(sent)
                except OSError:
                    # The client has read enough.
                    return

        server = threading.Thread(target=serve)
        server.start()
        with pytest.raises(error, match=said):
            TelemetryReader(path)
        server.join(30.0)


def test_a_message_that_comes_byte_by_byte_is_not_waited_for_longer(tmp_path: Path) -> None:
    path = tmp_path / "other.sock"
    done = threading.Event()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            client, _ = listener.accept()
            with client:
                # Each byte comes well within the time, but the line never ends.
                for _ in range(200):
                    if done.wait(0.05):
                        return
                    client.sendall(b" ")

        server = threading.Thread(target=serve)
        server.start()
        begun_s = time.monotonic()
        with pytest.raises(TimeoutError):
            TelemetryReader(path, timeout_s=0.5)
        took_s = time.monotonic() - begun_s
        done.set()
        server.join(30.0)
    assert 0.5 <= took_s < 5.0


def test_a_path_that_cannot_be_is_an_error_that_names_it(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(OSError, match=r"telemetry = .*file: is there and is no socket"):
        LiveMaster(scene_json(two_sides()), peer="127.0.0.1:9", run_id=1, insecure=True, telemetry=file)
    assert file.read_text() == "mine"
