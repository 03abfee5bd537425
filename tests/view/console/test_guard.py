"""Access to the console: its own page, and no page of another origin, whatever its browser sends."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.view.console.served import Served, http, served, stop_answers, wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("console")) as found:
        yield found


def live(runs: Served, *, origin: str | None, host: str | None = None, token: str | None = None) -> ClientConnection:
    port = runs.console.port
    headers = {} if host is None else {"Host": host}
    return connect(
        f"ws://127.0.0.1:{port}/{runs.token if token is None else token}/live",
        origin=None if origin is None else Origin(origin),
        additional_headers=headers,
        proxy=None,
        compression=None,
    )


def receive_all(page: ClientConnection) -> None:
    for _ in range(200):
        page.recv(timeout=5.0)


def test_the_page_is_whole_and_bound_to_itself(runs: Served) -> None:
    host = f"127.0.0.1:{runs.console.port}"
    for name in ("", "console.js", "console.css", "uplot.js", "uplot.css"):
        status, headers, body = http(runs.console.port, "GET", f"/{runs.token}/{name}", {"Host": host})
        assert (status, headers["cache-control"], headers["referrer-policy"]) == (200, "no-store", "no-referrer")
        assert "default-src 'none'" in headers["content-security-policy"]
        assert len(body) > 1000
        # The page works offline: it refers to no other host.
        assert b"//cdn" not in body
        assert b'src="http' not in body


@pytest.mark.parametrize(
    ("method", "path", "changed"),
    [
        ("GET", "/", {}),
        ("GET", "/wrong/", {}),
        ("GET", "/TOKEN", {}),
        ("GET", "/TOKEN/", {"Host": "haptether.example"}),
        ("GET", "/TOKEN/", {"Host": "127.0.0.1"}),
        ("GET", "/TOKEN/", {"Origin": "http://127.0.0.1:1"}),
        ("GET", "/TOKEN/", {"Origin": "null"}),
        ("GET", "/TOKEN/", {"Sec-Fetch-Site": "cross-site"}),
        ("POST", "/TOKEN/stop", {"Content-Length": "0"}),
        ("POST", "/TOKEN/stop", {"Content-Length": "0", "Origin": "http://127.0.0.1:1"}),
        ("POST", "/TOKEN/stop", {"Content-Length": "0", "Origin": "http://haptether.example"}),
        ("POST", "/wrong/stop", {"Content-Length": "0", "Origin": "HERE"}),
    ],
)
def test_others_get_nothing_and_stop_nothing(method: str, path: str, changed: dict[str, str], runs: Served) -> None:
    here = f"127.0.0.1:{runs.console.port}"
    headers = {"Host": here} | {name: value.replace("HERE", f"http://{here}") for name, value in changed.items()}
    status, _, body = http(runs.console.port, method, path.replace("TOKEN", runs.token), headers)
    assert status == 403
    assert len(body) < 100
    assert not runs.master.finished


def test_a_websocket_of_another_origin_is_refused(runs: Served) -> None:
    own = f"http://127.0.0.1:{runs.console.port}"
    for origin, host, token in (
        (None, None, None),
        ("http://127.0.0.1:1", None, None),
        ("http://haptether.example", None, None),
        ("null", None, None),
        ("http://haptether.example", "haptether.example", None),
        (own, "haptether.example", None),
        (own, None, "wrong"),
    ):
        # The server itself refuses a second Host as an invalid request.
        with pytest.raises(InvalidStatus) as refused:
            live(runs, origin=origin, host=host, token=token).close()
        assert refused.value.response.status_code in {400, 403}
    with live(runs, origin=own) as page:
        assert "rows" in str(page.recv(timeout=5.0))


def test_a_page_that_sends_what_is_no_request_is_closed(runs: Served) -> None:
    own = f"http://127.0.0.1:{runs.console.port}"
    for text in ("", "stop", '{"do":"stop","id":1}', '{"id":1,"side":"master","do":"press"}', "x" * 5000):
        with live(runs, origin=own) as page:
            page.send(text)
            with pytest.raises(ConnectionClosed):
                receive_all(page)
    assert not runs.master.finished


def test_the_stop_without_a_websocket(tmp_path: Path) -> None:
    with served(tmp_path) as runs:
        here = f"127.0.0.1:{runs.console.port}"
        headers = {"Host": here, "Origin": f"http://{here}", "Content-Length": "0"}
        status, _, body = http(runs.console.port, "POST", f"/{runs.token}/stop", headers)
        assert status == 200
        assert [answer["is_at_rest"] for answer in stop_answers(body).values()] == [True, True]
        wait_for(lambda: runs.master.finished and runs.slave.finished)
