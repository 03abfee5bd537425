"""Attackers without a key who can send to a real slave, or have recorded its traffic."""

import contextlib
import json
import random
import select
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from tests.faults.flood import HEADER, HELLO_BYTES, VERSION
from tests.faults.processes import DisturbedError, Judged, Limits, again, pair
from tests.faults.rows import Row
from tests.faults.running import END_S, PRESSED_S, Process, Recorded, Stage
from tests.faults.virtual import PERIOD_S, causes

REPLAYED = "replay of a recorded session to the slave, and to one started anew"
FUZZED = "header fuzz at the socket, 40000 datagrams"
REPEATED = "4000 recorded first messages/s beside a living session"
GARBAGE = "1e5 forged first messages/s while a master starts"
COPIED = "each frame copied from another address, 4 ms faster"
LAST_SEQUENCE = "in the clear, one frame with sequence 2^64 - 1"
START_S, START_LATER_S = 6.0, 1.5
"""Time in s for which the start of a session is watched, and largest delay by a flood: repeats of the first message."""
ANY_SESSION = 0x0123_4567_89AB_CDEF
FLOOD_S = 3.0
RATE_HZ, MIN_RATE_HZ = 1e5, 8e4
"""Requested rate, and the rate that a busy machine must reach for the row to count; the row reports the actual rate."""
LATE_SHARE = 0.005
"""Permitted increase of late cycles by the flood, as a share of all."""
COUNTED_SHARE = 0.5
"""Share of sent datagrams that must be counted: nobody sees those that a full socket drops."""
LATER_S = 0.5e-3
"""Permitted increase in s of the p99 of the wake lateness: half a period."""


class Relay:
    """Relay between a master and a slave that keeps the master's datagrams.

    With `behind_s` it delays the master's datagrams by that time, and sends a copy of each at once from another
    address.
    """

    def __init__(self, slave: str, behind_s: float = 0.0) -> None:
        host, port = slave.rsplit(":", 1)
        self._slave = (host, int(port))
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind(("127.0.0.1", 0))
        self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._far.connect(self._slave)
        self._done = threading.Event()
        self._behind_s = behind_s
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._copier = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._copier.connect(self._slave)
        self._copier.setblocking(False)
        self.recorded: list[bytes] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Address for the master."""
        host, port = self._near.getsockname()
        return f"{host}:{port}"

    def _run(self) -> None:
        master = None
        while not self._done.is_set():
            wait_s = max(self._waiting[0][0] - time.monotonic(), 0.0) if self._waiting else 0.05
            ready, _, _ = select.select([self._near, self._far], [], [], wait_s)
            while self._waiting and self._waiting[0][0] <= time.monotonic():
                with contextlib.suppress(OSError):
                    self._far.send(self._waiting.popleft()[1])
            if self._near in ready:
                datagram, master = self._near.recvfrom(2048)
                self.recorded.append(datagram)
                with contextlib.suppress(OSError):
                    if self._behind_s:
                        self._waiting.append((time.monotonic() + self._behind_s, datagram))
                        self._copier.send(datagram)
                    else:
                        self._far.send(datagram)
            if self._far in ready and master is not None:
                with contextlib.suppress(OSError):
                    self._near.sendto(self._far.recv(2048), master)

    def close(self) -> None:
        """End the relay."""
        self._done.set()
        self._thread.join()
        for used in (self._near, self._far, self._copier):
            used.close()


def send_all(to: str, datagrams: list[bytes], every: int = 50) -> int:
    """Send datagrams to an address, `every` of them per millisecond; return the number of answers within 0.3 s."""
    host, port = to.rsplit(":", 1)
    answers = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect((host, int(port)))
        sender.setblocking(False)
        for n, datagram in enumerate(datagrams):
            with contextlib.suppress(OSError):
                sender.send(datagram)
            if n % every == every - 1:
                time.sleep(1e-3)
        end = time.monotonic() + 0.3
        while time.monotonic() < end:
            with contextlib.suppress(OSError):
                sender.recv(2048)
                answers += 1
                continue
            time.sleep(0.01)
    return answers


def replayed_session(limits: Limits) -> Row:
    """Measure a replay, without the key, of all datagrams of a master."""
    with Stage.set() as stage:
        slave = stage.slave("slave")
        relay = Relay(slave.address)
        master = stage.master(relay.address, record=None)
        time.sleep(PRESSED_S)
        master.end()
        relay.close()
        time.sleep(0.3)
        again_at_s = time.time()
        # Send slowly: a busy system drops the part of a burst that overflows the socket's buffer.
        answers = send_all(slave.address, relay.recorded, every=5)
        slave.end()
        fresh = stage.slave("fresh")
        fresh_answers = send_all(fresh.address, relay.recorded, every=5)
        fresh.end()
        at_slave, at_fresh = stage.ticks("slave"), stage.ticks("fresh")
        reports = [stage.report("slave"), stage.report("fresh")]
    judged = Judged(limits)
    if not at_slave.ticks.coupled.any():
        raise DisturbedError("never engaged")
    judged.slave(at_slave)
    judged.slave(at_fresh)
    for ticks in (at_slave.ticks.between(again_at_s - at_slave.begun_s), at_fresh.ticks):
        judged.wrong.check(not ticks.coupled.any(), "a replay engaged")
        judged.wrong.check(np.ptp(ticks.output) == 0.0, "the command travelled")
    # First messages of handshakes are answered, within their budget: without the key an answer is useless.
    judged.wrong.check(answers + fresh_answers <= 16, f"{answers} + {fresh_answers} answers")
    refused = [sum(report["rejections"].values()) for report in reports]
    judged.wrong.check(min(refused) >= 0.9 * len(relay.recorded), f"{refused} of {len(relay.recorded)} refused")
    judged.say(
        f"{len(relay.recorded)} datagrams: {refused[0]} and {refused[1]} refused, {answers} and {fresh_answers} answers"
    )
    return judged.row(REPLAYED, "nothing engages, nothing moves")


def fuzz(count: int, seed: int) -> Iterator[bytes]:
    """Yield datagrams of every length, kind and header, valid in more and more places."""
    draw = random.Random(seed)
    for n in range(count):
        length = draw.choice((0, 1, 23, 24, 25, 119, 120, 121, 149, 150, 151, 189, 190, 191, 1400))
        head = b""
        if n % 4:
            version = draw.choice((0, 1, 2, 255)) if n % 2 else VERSION
            kind = draw.randrange(256) if n % 3 else 1 + n % 5
            counter = draw.choice((0, 1, 2**32, 2**64 - 1))
            head = HEADER.pack(b"HS", version, kind, draw.choice((0, 1, 2**32 - 1)), ANY_SESSION, counter)
        elif n % 16 == 4:
            head = b"HT"
        yield (head + draw.randbytes(1400))[:length]


def fuzzed(limits: Limits) -> Row:
    """Measure datagrams of all kinds beside a live session."""
    with Stage.set() as stage:
        slave, master = pair(stage)
        answers = send_all(slave.address, list(fuzz(40_000, seed=3)), every=20)
        stage.end_together(slave, master)
        sides = [stage.ticks("slave").before_end(), stage.ticks("master").before_end()]
        report = stage.report("slave")
    judged = Judged(limits)
    judged.never_held(*sides)
    judged.slave(sides[0])
    judged.wrong.check(answers == 0, f"{answers} answers")
    refused = sum(report["rejections"].values())
    judged.wrong.check(refused >= 35_000, f"{refused} refused")
    judged.say(f"{causes(report['rejections'])}; no answer, no hold")
    return judged.row(FUZZED, "counted, never answered, the loop goes on")


def living_session(port: int) -> tuple[int, int] | None:
    """Return session and counter of a frame on its way to a local port; None without permission to listen."""
    with contextlib.ExitStack() as stack:
        try:
            tap = stack.enter_context(socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(0x0800)))
            tap.bind(("lo", 0))
        except (OSError, AttributeError):
            return None
        tap.settimeout(0.5)
        end = time.monotonic() + 1.0
        with contextlib.suppress(OSError):
            while time.monotonic() < end:
                packet = tap.recv(2048)
                datagram = packet[(packet[0] & 15) * 4 :]
                if len(datagram) >= 8 + HEADER.size and struct.unpack_from("!H", datagram, 2)[0] == port:
                    magic, _, kind, _, session, counter = HEADER.unpack_from(datagram, 8)
                    if (magic, kind) == (b"HS", 3):
                        return session, counter
    return None


def flooded(name: str, kind: str, limits: Limits, *, knows_session: bool = False, seconds: float = FLOOD_S) -> Row:
    """Measure 1e5 forged packets per second, against the same time without."""
    with Stage.set() as stage:
        slave, master = pair(stage)
        seen = living_session(int(slave.address.rsplit(":", 1)[1])) if knows_session else None
        if knows_session and seen is None:
            return Row(fault=name, how="-", expected="-", measured="no leave to listen on lo", applies=False)
        session, counter = seen or (ANY_SESSION, 0)
        quiet_s = time.monotonic()
        time.sleep(seconds)
        # The counter is ahead of all that the master will send.
        header = ["--session", str(session), "--counter", str(counter + 100_000_000), "--kind", kind]
        begun_s = time.monotonic()
        sender = [sys.executable, "-m", "tests.faults.flood", slave.address]
        ended = subprocess.run(
            [*sender, "--rate", f"{RATE_HZ}", "--seconds", f"{seconds}", *header],
            capture_output=True, text=True, timeout=END_S, check=True,
        )  # fmt: skip
        flooded_s = time.monotonic()
        # Times are counted back from the last tick.
        stage.end_together(slave, master)
        sides = {"slave": stage.ticks("slave"), "master": stage.ticks("master")}
        report = stage.report("slave")
    sent = json.loads(ended.stdout)
    rate_hz, arrived = float(sent["rate_hz"]), sum(report["rejections"].values())
    if rate_hz < MIN_RATE_HZ:
        raise DisturbedError(f"the sender reached {rate_hz:.0f} a second, must be {MIN_RATE_HZ:g}")
    windows = {
        side: (
            _late(recorded, flooded_s - quiet_s, flooded_s - begun_s),
            _late(recorded, flooded_s - begun_s, 0.1),
        )
        for side, recorded in sides.items()
    }
    before, during = windows["slave"]
    for side in sides.values():
        if side.ticks.between(-np.inf, float(side.ticks.time_s[-1]) - (flooded_s - begun_s)).held.any():
            raise DisturbedError("held before the flood")
    judged = Judged(limits)
    # A loop that stalls during the flood is part of the measurement.
    judged.never_held(*(side.before_end() for side in sides.values()), excused=False)
    judged.slave(sides["slave"].before_end())
    judged.wrong.check(arrived >= COUNTED_SHARE * sent["datagrams"], f"{arrived} of {sent['datagrams']} counted")
    judged.wrong.check(
        during[0] <= before[0] + LATER_S, f"p99 of waking late went from {before[0]:g} to {during[0]:g} s"
    )
    judged.wrong.check(during[1] <= before[1] + LATE_SHARE, f"late cycles went from {before[1]:.2%} to {during[1]:.2%}")
    judged.say(
        f"{rate_hz:.0f}/s sent, {arrived / sent['seconds']:.0f}/s refused; "
        f"wakes late p99 {before[0] * 1e6:.0f} us without, {during[0] * 1e6:.0f} us with; "
        f"late cycles {before[1]:.2%}, {during[1]:.2%}; no hold"
    )
    return judged.row(name, "no hold, timing stays")


def _late(recorded: Recorded, from_end_s: float, until_end_s: float) -> tuple[float, float]:
    """Return p99 of the wake lateness in s and the share of late cycles, for times counted back from the last tick."""
    time_s = recorded.ticks.time_s
    inside = (time_s >= time_s[-1] - from_end_s) & (time_s < time_s[-1] - until_end_s)
    late_s = np.asarray(recorded.overshoot_s)[inside]
    if not late_s.size:
        raise DisturbedError("no ticks")
    return float(np.percentile(late_s, 99)), float(np.mean(late_s > PERIOD_S))


def repeated_first_message(limits: Limits) -> Row:
    """Measure the authentic first message of an earlier session, 4000 times per second beside a live session."""
    with Stage.set() as stage:
        slave = stage.slave("slave")
        relay = Relay(slave.address)
        former = stage.master(relay.address, "before", record=None)
        time.sleep(PRESSED_S)
        former.end()
        relay.close()
        first = next(datagram for datagram in relay.recorded if len(datagram) == HELLO_BYTES)
        master = stage.master(slave.address)
        time.sleep(PRESSED_S)
        begun_s = time.monotonic()
        answers = send_all(slave.address, [first] * 12_000, every=4)
        took_s = time.monotonic() - begun_s
        ended_s = time.monotonic()
        stage.end_together(slave, master)
        sides = [stage.ticks("slave").before_end(), stage.ticks("master").before_end()]
        said = slave.said
    judged = Judged(limits)
    attacked_s = ended_s - begun_s
    before = sides[0].last(attacked_s + 0.5).ticks
    if not before.between(-np.inf, float(before.time_s[0]) + 0.3).coupled.all():
        raise DisturbedError("not engaged before the first of them")
    # The slave also recorded the earlier session and its end.
    judged.never_held(sides[0].last(attacked_s), sides[1])
    judged.slave(sides[0])
    judged.wrong.check(answers <= 4 + took_s, f"{answers} answers in {took_s:.1f} s")
    judged.wrong.check("another master" not in said, "a replay was reported as another master")
    judged.say(f"{12_000 / took_s:.0f}/s sent, {answers} answers in {took_s:.1f} s; no hold, nothing reported")
    return judged.row(REPEATED, "the session goes on; one answer a second; no other master is reported")


def garbage_at_start(limits: Limits) -> Row:
    """Measure the start of a master beside 1e5 forged first messages per second."""
    engaged_s: list[float] = []
    rate_hz = 0.0
    for floods in (False, True):
        with Stage.set() as stage:
            slave = stage.slave("slave", record=None)
            sender = [sys.executable, "-m", "tests.faults.flood", slave.address, "--kind", "hello"]
            flooding = subprocess.Popen(
                [*sender, "--rate", f"{RATE_HZ}", "--seconds", f"{START_S}"], stdout=subprocess.PIPE, text=True
            ) if floods else None  # fmt: skip
            time.sleep(0.5)
            master = stage.master(slave.address, record=None)
            time.sleep(START_S - 1.0)
            stage.end_together(slave, master)
            engaged_s.append(stage.report("master")["engaged_s"] or float("inf"))
            if flooding is not None:
                rate_hz = float(json.loads(flooding.communicate(timeout=END_S)[0])["rate_hz"])
    if rate_hz < MIN_RATE_HZ:
        raise DisturbedError(f"the sender reached {rate_hz:.0f} a second, must be {MIN_RATE_HZ:g}")
    judged = Judged(limits)
    later_s = engaged_s[1] - engaged_s[0]
    judged.wrong.check(later_s <= START_LATER_S, f"engaged {later_s:.2f} s later")
    judged.say(f"engaged after {engaged_s[0]:.2f} s without, {engaged_s[1]:.2f} s with {rate_hz:.0f}/s")
    return judged.row(GARBAGE, f"the start takes at most {START_LATER_S:g} s longer")


def copied(limits: Limits) -> Row:
    """Measure a copy of each frame of the master from another address, 4 ms ahead of the frame."""
    with Stage.set() as stage:
        slave = stage.slave()
        relay = Relay(slave.address, behind_s=4e-3)
        master = stage.master(relay.address)
        time.sleep(PRESSED_S + 1.0)
        stage.end_together(slave, master)
        relay.close()
        sides = [stage.ticks("slave").before_end(), stage.ticks("master").before_end()]
        duplicates = stage.report("slave")["rejections"].get("counter seen before", 0)
    judged = Judged(limits)
    judged.never_held(*sides)
    judged.slave(sides[0])
    judged.wrong.check(duplicates > 1000, f"{duplicates} originals arrived second")
    judged.say(f"{duplicates} originals arrived second; no hold")
    return judged.row(COPIED, "the answers still reach the master")


def last_sequence(limits: Limits) -> Row:
    """Measure one frame of the live session, in the clear, with the highest possible sequence."""
    with Stage.set() as stage:
        options = ("--insecure", "--json", str(stage.path("slave.json")))
        slave = Process("slave", "--listen", "127.0.0.1:0", *options, record=stage.path("slave.mcap"))
        stage.processes.append(slave)
        relay = Relay(slave.address)
        options = ("--insecure", "--json", str(stage.path("master.json")))
        master = Process("master", "--peer", relay.address, *options, record=stage.path("master.mcap"))
        stage.processes.append(master)
        time.sleep(PRESSED_S)
        frame = bytearray(relay.recorded[-1][:-4])
        struct.pack_into("<Q", frame, 16, 2**64 - 1)
        send_all(slave.address, [bytes(frame) + struct.pack("<I", zlib.crc32(frame))])
        time.sleep(0.5)
        stage.end_together(slave, master)
        relay.close()
        sides = [stage.ticks("slave").before_end(), stage.ticks("master").before_end()]
        refused = stage.report("slave")["refused"]
    judged = Judged(limits)
    judged.never_held(*sides)
    judged.slave(sides[0])
    judged.wrong.check(refused >= 1, "the frame was taken")
    judged.say("refused; no hold")
    return judged.row(LAST_SEQUENCE, "refused, the session goes on")


FLOODS = (
    ("1e5 forged frames/s, of the living session", "frame", True),
    ("1e5 forged frames/s, of any session", "frame", False),
    ("1e5 forged first messages/s", "hello", False),
)


def rows(limits: Limits | None = None) -> dict[str, Callable[[], Row]]:
    """Return all measurements by name, to be run one after the other."""
    bounds = limits or Limits()
    measures: dict[str, Callable[[Limits], Row]] = {
        REPLAYED: replayed_session,
        FUZZED: fuzzed,
        REPEATED: repeated_first_message,
        GARBAGE: garbage_at_start,
        COPIED: copied,
        LAST_SEQUENCE: last_sequence,
    }
    for name, kind, knows in FLOODS:
        measures[name] = partial(flooded, name, kind, knows_session=knows)
    return {fault: again(partial(measure, bounds), fault) for fault, measure in measures.items()}
