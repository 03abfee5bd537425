"""Programs of `test_two_addresses.py` for two machines: `serve` on one, `ask` on the other."""

import json
import secrets
import sys
import time

from tests.scene.two_sides import two_sides

from haptether.bridge import LiveMaster, LiveSlave, scene_json
from haptether.netsim import Echo, LinkSettings, Proxy, record

PATIENCE_S = 10.0


def serve(allow: tuple[str, ...]) -> None:
    """Serve at all addresses of this machine until standard input ends; print the ports."""
    perfect = LinkSettings()
    ports, kept = {}, []
    for bound in ("0.0.0.0:0", "[::]:0"):
        echo, far = Echo(listen=bound), Echo(listen="127.0.0.1:0")
        proxy = Proxy(
            listen=bound, forward=far.address, forward_link=perfect, backward_link=perfect, allow=allow, realtime=False
        )
        slave = LiveSlave(scene_json(two_sides()), listen=bound, run_id=1, insecure=True, realtime="off")
        kept.append((echo, far, proxy, slave))
        ports[bound] = {
            name: int(of.address.rpartition(":")[2])
            for name, of in (("echo", echo), ("proxy", proxy), ("slave", slave))
        }
    print(json.dumps(ports), flush=True)
    sys.stdin.read()


def ask(peers: dict[str, str]) -> None:
    """Print the error of each peer by name; empty for a peer that answered."""
    answers = {}
    for name, peer in peers.items():
        answers[name] = _of_slave(peer) if name.endswith("slave") else _of_echo(peer)
    print(json.dumps(answers))


def _of_echo(peer: str) -> str:
    try:
        record(peer, rate_hz=200.0, duration_s=0.02, realtime=False)
    except OSError as error:
        return str(error)
    return ""


def _of_slave(peer: str) -> str:
    scene, run = scene_json(two_sides()), secrets.randbits(64)
    master = LiveMaster(scene, peer=peer, run_id=run, insecure=True, patience_s=PATIENCE_S, realtime="off")
    until = time.monotonic() + PATIENCE_S
    while not master.is_answered and time.monotonic() < until:
        time.sleep(0.005)
    answered, events = master.is_answered, master.security_events()
    _, report = master.finish()
    return "" if answered and not report.rejections else f"{answered=} {events} {report.rejections}"


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(tuple(sys.argv[2:]))
    else:
        ask(json.loads(sys.argv[2]))
