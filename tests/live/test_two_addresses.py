"""A machine bound to several addresses answers from the address that a client used."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

pytestmark = pytest.mark.live

ROOT = Path(__file__).parents[2]
PROGRAM = (sys.executable, "-m", "tests.live.host_with_two_addresses")


class Machine:
    """Network namespace that lasts as long as its process."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self.pid = process.pid
        self._within = ("nsenter", "--target", str(self.pid), "--net")

    def ip(self, *arguments: str) -> str:
        command = (*self._within, "ip", *arguments)
        return subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout

    def start(self, *arguments: str) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            (*self._within, *PROGRAM, *arguments),
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip


@pytest.fixture
def machines() -> Iterator[tuple[Machine, Machine]]:
    """Connect two machines with a cable: one has two addresses of each kind, the other one."""
    if os.geteuid() != 0 or any(shutil.which(name) is None for name in ("unshare", "nsenter", "ip")):
        pytest.skip("network namespaces need root, unshare, nsenter and ip")
    with ExitStack() as stack:
        processes = [
            stack.enter_context(subprocess.Popen(("unshare", "--net", "sleep", "120"), stderr=subprocess.PIPE))
            for _ in range(2)
        ]
        for process in processes:
            stack.callback(process.kill)
        own = Path("/proc/self/ns/net").readlink()
        for process in processes:
            until = time.monotonic() + 10.0
            while Path(f"/proc/{process.pid}/ns/net").readlink() == own:
                if process.poll() is not None or time.monotonic() > until:
                    pytest.skip("this machine allows no network namespace")
                time.sleep(0.01)
        server, client = map(Machine, processes)
        for machine in (server, client):
            machine.ip("link", "set", "lo", "up")
        try:
            server.ip("link", "add", "cable", "type", "veth", "peer", "name", "plug", "netns", str(client.pid))
        except subprocess.CalledProcessError as error:
            pytest.skip(f"this machine has no virtual Ethernet: {error.stderr.strip()}")
        for machine, link, addresses in (
            (server, "cable", ("10.77.0.1/24", "10.77.0.2/24", "fd77::1/64", "fd77::2/64")),
            (client, "plug", ("10.77.0.9/24", "fd77::9/64")),
        ):
            for address in addresses:
                # The addresses are usable at once: nobody else has them.
                flags = ("nodad",) if ":" in address else ()
                machine.ip("address", "add", address, "dev", link, *flags)
            machine.ip("link", "set", link, "addrgenmode", "none")
            machine.ip("link", "set", link, "up")
            machine.ip("address", "add", f"fe80::{'1' if link == 'cable' else '9'}/64", "dev", link, "nodad")
        yield server, client


@pytest.mark.timeout(60)
def test_the_answer_comes_from_the_address_that_was_asked(machines: tuple[Machine, Machine]) -> None:
    server, client = machines
    serving = server.start("serve", "10.77.0.9", "fd77::9", "fe80::9%cable")
    try:
        assert serving.stdout is not None
        ports = json.loads(serving.stdout.readline())
        v4, v6 = ("10.77.0.1", "10.77.0.2"), ("[fd77::1]", "[fd77::2]", "[fe80::1%plug]")
        peers = {
            f"{bound} {host} {kind}": f"{host}:{port}"
            for bound, hosts in (("0.0.0.0:0", v4), ("[::]:0", (*v6, *v4)))
            for host in hosts
            for kind, port in ports[bound].items()
            # A slave serves one master only, which uses the second address.
            if kind != "slave" or (bound, host) in {("0.0.0.0:0", v4[1]), ("[::]:0", v6[1])}
        }
        asking = client.start("ask", json.dumps(peers))
        answers, _ = asking.communicate(timeout=50)
        assert json.loads(answers) == dict.fromkeys(peers, "")
    finally:
        serving.communicate(timeout=10)


def test_a_second_address_of_loopback_is_answered_from_there() -> None:
    """Test the same without a network namespace, over IPv4."""
    serving = subprocess.Popen((*PROGRAM, "serve"), cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert serving.stdout is not None
        ports = json.loads(serving.stdout.readline())["0.0.0.0:0"]
        peers = {kind: f"127.0.0.77:{port}" for kind, port in ports.items()}
        asked = subprocess.run(
            (*PROGRAM, "ask", json.dumps(peers)), cwd=ROOT, capture_output=True, text=True, timeout=40, check=True
        )
        assert json.loads(asked.stdout) == dict.fromkeys(peers, "")
    finally:
        serving.communicate(timeout=10)
