"""The live proxy and the measurement of a network, from Python."""

import csv
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from haptether.netsim import Echo, LinkSettings, Proxy, record

pytestmark = pytest.mark.live

PATIENCE_S = 5.0


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(PATIENCE_S)
        yield peer


def name_of(end: socket.socket) -> str:
    host, port = end.getsockname()
    return f"{host}:{port}"


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < until:
        time.sleep(0.005)
    assert condition()


def test_the_log_says_what_became_of_each_datagram(peer: socket.socket, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    link = LinkSettings(delay_s=0.01)
    proxy = Proxy(
        listen="127.0.0.1:0", forward=name_of(peer), forward_link=link, backward_link=link, log=log, realtime=False
    )
    host, port = proxy.address.split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        for size in range(1, 11):
            client.sendto(bytes(size), (host, int(port)))
            assert len(peer.recv(64)) == size
        proxy.change("forward", LinkSettings(loss=1.0))
        # The change takes effect within 20 ms.
        time.sleep(0.1)
        client.sendto(b"lost", (host, int(port)))
        wait_for(lambda: proxy.statistics().forward.lost == 1)
    statistics = proxy.stop()
    assert (statistics.early, statistics.log_lost, statistics.flows) == (0, 0, 1)
    assert statistics.scheduling == "normal"
    assert statistics.forward.dropped["loss"] == 1
    with log.open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert [int(row["size"]) for row in rows] == [*range(1, 11), 4]
    assert [row["cause"] for row in rows] == [""] * 10 + ["loss"]
    assert [row["t_out_ns"] == "" for row in rows] == [False] * 10 + [True]
    for index, row in enumerate(rows[:10]):
        assert (row["direction"], row["index"], row["kind"]) == ("forward", str(index), "")
        received, due, left = (int(row[key]) for key in ("t_in_ns", "t_due_ns", "t_out_ns"))
        assert due == received + 10_000_000
        assert left - due == int(row["error_ns"]) >= 0


def test_what_a_proxy_cannot_do_is_said(peer: socket.socket) -> None:
    perfect = LinkSettings()

    def start(**keywords: object) -> Proxy:
        return Proxy(
            listen="127.0.0.1:0",
            forward=name_of(peer),
            forward_link=perfect,
            backward_link=perfect,
            **keywords,  # type: ignore[arg-type]
        )

    with pytest.raises(ValueError, match=r'^allow = "master": must be an IP address or IP:PORT'):
        start(allow=["master"])
    with pytest.raises(OSError, match=r"^max_error_s = 0: must be a finite number above 0, at most 1$"):
        start(max_error_s=0.0)
    with pytest.raises(OSError, match=r"^log = /nowhere/log\.csv: "):
        start(log="/nowhere/log.csv")
    proxy = start(allow=["192.0.2.7", "192.0.2.8:9100"])
    with pytest.raises(ValueError, match=r"^direction = "):
        proxy.change("sideways", perfect)  # type: ignore[arg-type]
    proxy.stop()


def test_a_measured_network_is_the_one_there_is(tmp_path: Path) -> None:
    echo = Echo(listen="127.0.0.1:0")
    proxy = Proxy(
        listen="127.0.0.1:0",
        forward=echo.address,
        forward_link=LinkSettings(delay_s=0.01),
        backward_link=LinkSettings(delay_s=0.02, loss=0.2),
        seed=5,
    )
    recording = record(proxy.address, rate_hz=500.0, duration_s=0.6)
    statistics = proxy.stop()
    assert echo.stop() == (300, 0)
    assert len(recording) == 300
    lost = np.isnan(recording.backward_delay_s)
    assert np.count_nonzero(lost) == recording.lost_backward
    # The direction of answers lost at the end is unknown.
    total = recording.lost_forward + recording.lost_backward
    assert total == statistics.backward.lost > 0
    assert 0.030 <= recording.shortest_s <= 0.040
    path = tmp_path / "network.csv"
    recording.write_csv(path)
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert lines[0] == "time_s,forward_delay_s,backward_delay_s"
    assert len(lines) == 301
    assert sum(line.endswith(",") for line in lines) == recording.lost_backward


def test_a_measurement_that_cannot_be_made_says_why(peer: socket.socket) -> None:
    with pytest.raises(ValueError, match=r"^rate_hz = 2000: must be a finite number from 0.001 to 1000$"):
        record(name_of(peer), rate_hz=2000.0)
    with pytest.raises(ValueError, match=r"^duration_s = NaN: "):
        record(name_of(peer), duration_s=float("nan"))


def test_a_log_on_a_full_disk_costs_the_log_and_not_the_figures(peer: socket.socket) -> None:
    link = LinkSettings()
    proxy = Proxy(
        listen="127.0.0.1:0", forward=name_of(peer), forward_link=link, backward_link=link, log="/dev/full",
        realtime=False, max_error_s=1.0,
    )  # fmt: skip
    host, port = proxy.address.split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.sendto(b"one", (host, int(port)))
        assert peer.recv(64) == b"one"
    statistics = proxy.stop()
    assert statistics.forward.released == 1
    assert statistics.log_failed
    assert not statistics.valid
