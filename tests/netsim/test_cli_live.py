"""`haptether netsim proxy`, `set`, `echo` and `record` as processes, with loose bounds on time."""

import csv
import importlib.util
import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import pytest

from haptether.cli.entry import main

pytestmark = pytest.mark.live

COMMAND = [sys.executable, "-m", "haptether", "netsim"]
PATIENCE_S = 30.0
# On a busy machine p99 may have any value.
ANY_ERROR = ("--max-error-s", "1")


class Child:
    """A running command with its first line, which says that its socket is open."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stderr is not None
        self.headline = self.process.stderr.readline()

    def address(self) -> str:
        found = re.search(r"listens on (\S+:\d+)", self.headline)
        assert found, self.headline
        return found[1]

    def end(self) -> tuple[str, str]:
        """Ask it to end and return its standard output and standard error."""
        self.process.send_signal(signal.SIGINT)
        return self.process.communicate(timeout=PATIENCE_S)


Start = Callable[..., Child]


@pytest.fixture
def start() -> Iterator[Start]:
    running: list[Child] = []

    def begin(*arguments: str) -> Child:
        running.append(Child(*arguments))
        return running[-1]

    yield begin
    for child in running:
        if child.process.poll() is None:
            child.process.kill()
        child.process.communicate()


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )  # fmt: skip


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(PATIENCE_S)
        yield peer


def to(peer: socket.socket) -> list[str]:
    host, port = peer.getsockname()
    return ["proxy", "--listen", "127.0.0.1:0", "--forward", f"{host}:{port}"]


class Client:
    """Sends datagrams through a proxy and returns their travel times."""

    def __init__(self, proxy: Child, peer: socket.socket) -> None:
        host, port = proxy.address().split(":")
        self._to = (host, int(port))
        self._peer = peer
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def send(self) -> None:
        self._socket.sendto(b"datagram", self._to)

    def taken_s(self) -> float:
        begun = time.monotonic()
        self.send()
        assert self._peer.recv(64) == b"datagram"
        return time.monotonic() - begun


def test_a_proxy_says_how_good_it_was(start: Start, peer: socket.socket) -> None:
    proxy = start(*to(peer), "--delay-s", "0.01", "--loss", "0", "--no-realtime", "--allow", "192.0.2.7",
                  "--allow", "192.0.2.8:9100", *ANY_ERROR, "--json", "-")  # fmt: skip
    with Client(proxy, peer) as client:
        for _ in range(20):
            assert client.taken_s() >= 0.01
    out, said = proxy.end()
    assert proxy.process.returncode == 0, said
    report = json.loads(out)
    assert report["forward"]["received"] == report["forward"]["released"] == 20
    assert report["forward"]["dropped"] == {}
    assert (report["valid"], report["scheduling"], report["early"], report["flows"]) == (True, "normal", 0, 1)
    assert report["max_error_s"] == 1.0
    assert report["receive_buffer_bytes"] > 0
    errors = [report[f"scheduling_error_{name}_s"] for name in ("p50", "p99", "p999", "max")]
    assert errors == sorted(errors)
    for word in ("p50", "p99", "p99.9", "max", "1 flows", "0 datagrams refused", "scheduling class normal", "buffers"):
        assert word in said
    assert "INVALID" not in said


def test_a_run_that_is_too_late_is_invalid(start: Start, peer: socket.socket) -> None:
    # No machine sends within a nanosecond of the due time.
    proxy = start(*to(peer), "--delay-s", "0.001", "--max-error-s", "1e-9", "--json", "-")
    with Client(proxy, peer) as client:
        client.taken_s()
    out, said = proxy.end()
    assert proxy.process.returncode == 1
    assert "INVALID: p99 of the scheduling error is " in said
    assert json.loads(out)["valid"] is False


def test_drops_are_counted_by_cause(start: Start, peer: socket.socket) -> None:
    proxy = start(*to(peer), "--loss", "1", *ANY_ERROR, "--duration-s", "2", "--json", "-")
    with Client(proxy, peer) as client:
        for _ in range(5):
            client.send()
    out, said = proxy.process.communicate(timeout=PATIENCE_S)
    assert "dropped forward: loss 5" in said
    assert json.loads(out)["forward"]["dropped"] == {"loss": 5}


@pytest.mark.parametrize("name", ["log.csv", "log.parquet"])
def test_the_log_has_a_row_per_datagram(start: Start, peer: socket.socket, tmp_path: Path, name: str) -> None:
    log = tmp_path / name
    proxy = start(*to(peer), "--delay-s", "0.01", "--log", str(log), *ANY_ERROR)
    with Client(proxy, peer) as client:
        for _ in range(10):
            client.taken_s()
    _, said = proxy.end()
    assert proxy.process.returncode == 0, said
    assert [path.name for path in tmp_path.iterdir()] == [name]
    rows: list[dict[str, Any]]
    if name.endswith(".csv"):
        with log.open(newline="") as lines:
            rows = list(csv.DictReader(lines))
    else:
        import polars as pl

        rows = pl.read_parquet(log).to_dicts()
    assert list(rows[0]) == [
        "direction", "index", "kind", "t_in_ns", "t_due_ns", "t_out_ns", "cause", "error_ns", "size",
    ]  # fmt: skip
    assert [int(row["index"]) for row in rows] == list(range(10))
    assert {(row["direction"], row["kind"], row["cause"], int(row["size"])) for row in rows} == {("forward", "", "", 8)}
    assert all(int(row["t_due_ns"]) == int(row["t_in_ns"]) + 10_000_000 for row in rows)


def test_an_empty_log_has_its_columns_and_types(start: Start, peer: socket.socket, tmp_path: Path) -> None:
    import polars as pl

    proxy = start(*to(peer), "--log", str(tmp_path / "log.parquet"), "--duration-s", "0")
    assert proxy.process.wait(PATIENCE_S) == 0
    columns = pl.read_parquet_schema(tmp_path / "log.parquet")
    assert columns["t_out_ns"] == pl.Int64()
    assert columns["cause"] == pl.String()
    assert len(columns) == 9


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["unix", "tcp"])
def test_a_change_is_seen_by_live_datagrams(start: Start, peer: socket.socket, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "control"
    proxy = start(*to(peer), "--control", str(path) if kind == "unix" else "127.0.0.1:0", *ANY_ERROR)
    found = re.search(r"controlled by (\S+)", proxy.headline)
    assert found
    control = ["--control", found[1]]
    if kind == "unix":
        assert path.stat().st_mode & 0o777 == 0o600
    with Client(proxy, peer) as client:
        client.taken_s()
        changed = run("set", *control, "delay-s=0.4", "backward.loss=0.02", "--show")
        assert changed.returncode == 0, changed.stderr
        assert "forward: delay_s = 0.4\n" in changed.stdout
        assert "backward: loss = 0.02, delay_s = 0.4\n" in changed.stdout
        assert "so far forward: 1 received, 1 released, 0 lost" in changed.stdout
        time.sleep(0.2)
        assert client.taken_s() >= 0.4
        refused = run("set", *control, "backward.delay_s=0", "forward.loss=2")
        assert refused.returncode == 2
        assert refused.stderr == (
            "haptether: the proxy changed nothing: forward.loss = 2: must be a number from 0 to 1\n"
        )
        shown = run("set", *control, "--json", "-")
        report = json.loads(shown.stdout)
        assert report["forward"] == {"delay_s": 0.4}
        assert report["backward"] == {"loss": 0.02, "delay_s": 0.4}
        assert report["statistics"]["forward"]["released"] == 2
        assert run("set", *control, "delay_s=").returncode == 0
        time.sleep(0.2)
        assert client.taken_s() < 0.4
    proxy.end()
    assert proxy.process.returncode == 0
    assert not path.exists()
    gone = run("set", *control, "--show")
    assert gone.returncode == 1
    assert gone.stderr.startswith(f'haptether: control = "{found[1]}": ')


@pytest.mark.parametrize(
    ("arguments", "said", "status"),
    [
        (["--control", "0.0.0.0:9100"], 'control = "0.0.0.0:9100": must be the path of a Unix socket, or 127', 2),
        (["--control", "192.0.2.7:9100"], "of this machine", 2),
        (["--control", "example.org:9100"], "of this machine", 2),
        (["--control", "/nowhere/control"], 'control = "/nowhere/control": No such file or directory', 1),
        (["--log", "log.txt"], "log = log.txt: must end in .csv or .parquet", 2),
        (["--log", "/nowhere/log.parquet"], "/nowhere/log.parquet: cannot be written", 1),
        (["--max-error-s", "0"], "max_error_s = 0: must be above 0 and at most 1 s", 2),
        (["--max-error-s", "nan"], "max_error_s = nan: must be above 0", 2),
        (["--allow", "master"], 'allow = "master": must be an IP address or IP:PORT', 2),
        (["--trace", "/nowhere/a.csv"], "[link.forward.trace] file: /nowhere/a.csv: cannot be read: No such file", 2),
    ],
)
def test_a_bad_request_is_one_line(
    arguments: list[str], said: str, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    proxy = ["netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9", "--duration-s", "0"]
    assert main([*proxy, *arguments]) == status
    stderr = capsys.readouterr().err
    assert said in stderr
    assert stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing to change: give KEY=VALUE, or --show"),
        (["delay_s"], "delay_s: must be KEY=VALUE, forward.KEY=VALUE or backward.KEY=VALUE"),
        (["forward.outages.0.effect=hold"], "must be KEY=VALUE"),
        (["delay_s=0.1", "loss=0", "delay-s=0.2"], "delay_s, delay-s: one setting is given twice"),
        (["dela_s=1"], "has no key dela_s: did you mean delay_s?"),
    ],
)
def test_a_change_that_is_none_is_refused_before_it_is_sent(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["netsim", "set", "--control", "/nowhere/control", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_parquet_without_polars_is_refused_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "polars" else found(name, *rest)
    )
    log = tmp_path / "log.parquet"
    arguments = ["netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9", "--log", str(log)]
    assert main(arguments) == 1
    assert "polars is not installed: install haptether[analysis]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_measured_network_is_replayed(start: Start, tmp_path: Path) -> None:
    echo = start("echo", "--listen", "127.0.0.1:0", "--json", "-")
    proxy = start("proxy", "--listen", "127.0.0.1:0", "--forward", echo.address(), "--delay-s", "0.01",
                  "--backward.delay-s", "0.03", "--backward.loss", "0.2", *ANY_ERROR)  # fmt: skip
    recording = tmp_path / "network.csv"
    measured = run("record", proxy.address(), "--rate", "200", "--duration-s", "2.5", "--csv", str(recording),
                   "--no-realtime", "--json", "-")  # fmt: skip
    assert measured.returncode == 0, measured.stderr
    figures = json.loads(measured.stdout)
    assert figures["probes"] == 500
    assert 0.04 <= figures["shortest_s"] <= figures["round_trip_p50_s"] <= 0.14
    assert figures["round_trip_p99_s"] >= figures["round_trip_p50_s"]
    # A fifth of 500 answers, within five deviations of 9. The direction of losses at the end is unknown.
    assert 55 <= figures["lost_backward"] + figures["lost_forward"] <= 145
    assert figures["worst_gap_s"] >= 0.005
    for word in ("round trip", "p50", "p99", "lost", "worst gap", "only the sum of both ways is certain", "--trace"):
        assert word in measured.stderr
    proxy.end()
    answered, _ = echo.end()
    assert echo.process.returncode == 0
    assert json.loads(answered) == {"answered": 500, "ignored": 0}

    sampled = run("sample", "--trace", str(recording), "--direction", "backward", "--packets", "400", "--rate", "200",
                  "--json", "-")  # fmt: skip
    assert sampled.returncode == 0, sampled.stderr
    realised = json.loads(sampled.stdout)["realised"]
    assert realised["mean_s"] == pytest.approx(figures["backward_p50_s"], abs=0.05)
    assert 0.05 <= realised["loss"] <= 0.35
    scene = tmp_path / "scene.toml"
    scene.write_text('schema = 1\n[link.backward]\ntrace = { file = "network.csv" }\n')
    again = run("sample", str(scene), "--direction", "backward", "--packets", "400", "--rate", "200", "--json", "-")
    assert json.loads(again.stdout)["realised"] == realised
    replaying = start("proxy", "--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9", "--trace", str(recording))
    assert replaying.address()


def test_a_measurement_that_cannot_be_made_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said, status in (
        (["127.0.0.1:9", "--rate", "2000"], "rate_hz = 2000: must be a finite number from 0.001 to 1000", 2),
        (["127.0.0.1:9", "--duration-s", "nan"], "duration_s = NaN: must be", 2),
        (["nowhere"], 'peer = "nowhere": ', 2),
        (["127.0.0.1:9", "--csv", "-"], "csv = -: must be a file", 2),
        (["127.0.0.1:9", "--csv", str(tmp_path / "missing" / "a.csv")], "cannot be written", 1),
        (["127.0.0.1:9", "--duration-s", "0.1"], "none of ", 1),
    ):
        assert main(["netsim", "record", *arguments]) == status
        stderr = capsys.readouterr().err
        assert said in stderr
        assert stderr.count("\n") == 1


def test_an_echo_ends_by_itself() -> None:
    ended = run("echo", "--listen", "127.0.0.1:0", "--duration-s", "0.1")
    assert ended.returncode == 0
    assert "0 probes answered, 0 other datagrams ignored" in ended.stdout
