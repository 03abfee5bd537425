"""An emulated controller as a process, and ur_rtde as another: a hanging call of ur_rtde can only be killed."""

import itertools
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

START_S = 30.0
ANSWER_S = 10.0
_numbers = itertools.count(1)


def free_host() -> str:
    """Return a local address that no other test process uses: the ports are the same on all of them."""
    process, number = os.getpid(), next(_numbers)
    return f"127.{64 + process // 250 % 128}.{process % 250 + 1}.{number % 250 + 1}"


class Emulated:
    """A running controller, and its control line."""

    def __init__(self, process: "subprocess.Popen[bytes]", host: str) -> None:
        self.process = process
        self.host = host
        self._waiting = b""

    def line(self, patience_s: float = ANSWER_S) -> str:
        """Return the next line of its output."""
        assert self.process.stdout is not None
        end = time.monotonic() + patience_s
        while b"\n" not in self._waiting:
            left = end - time.monotonic()
            if left <= 0.0 or not select.select([self.process.stdout], [], [], left)[0]:
                message = f"the emulator said nothing for {patience_s} s"
                raise TimeoutError(message)
            received = os.read(self.process.stdout.fileno(), 1 << 16)
            if not received:
                message = f"the emulator ended with {self.process.wait(ANSWER_S)}"
                raise RuntimeError(message)
            self._waiting += received
        line, self._waiting = self._waiting.split(b"\n", 1)
        return line.decode()

    def request(self, line: str) -> str:
        """Return the answer to a control line."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{line}\n".encode())
        self.process.stdin.flush()
        return self.line()

    def do(self, line: str) -> str:
        """Return the result of a control line that must succeed."""
        answer = self.request(line)
        assert answer.startswith("ok"), answer
        return answer[3:]

    def status(self) -> dict[str, Any]:
        """Return state and figures."""
        status: dict[str, Any] = json.loads(self.do("status"))
        return status

    def wait_for(self, key: str, value: object, patience_s: float = 10.0) -> dict[str, Any]:
        """Return the state once one of its values is the expected one."""
        end = time.monotonic() + patience_s
        while (status := self.status())[key] != value:
            if time.monotonic() > end:
                message = f"{key} = {status[key]!r}: was to become {value!r}"
                raise TimeoutError(message)
            time.sleep(0.02)
        return status


@contextmanager
def process_of(command: Sequence[str]) -> "Iterator[subprocess.Popen[bytes]]":
    """Run an emulator with pipes for input and output; end it in any case."""
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(5.0)
        finally:
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    stream.close()


@contextmanager
def emulator(*arguments: str, host: str | None = None) -> Iterator[Emulated]:
    """Run `haptether ur-emulator` with its control line on standard input, and end it in any case."""
    host = host or free_host()
    command = [sys.executable, "-m", "haptether", "ur-emulator", "--host", host, "--control", "-", *arguments]
    with process_of(command) as process:
        emulated = Emulated(process, host)
        assert emulated.line(START_S).startswith(f"listening on {host} ")
        yield emulated


def client(scenario: str, host: str, arguments: Sequence[object] = (), patience_s: float = 30.0) -> dict[str, Any]:
    """Return the result of a scenario of `tests.ur.clients`, in a process that is killed if ur_rtde hangs."""
    command = [sys.executable, "-m", "tests.ur.clients", scenario, host, json.dumps(list(arguments))]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=patience_s, check=False)
    assert ended.returncode == 0, f"{scenario}: {ended.stderr}{ended.stdout}"
    return result_of(ended.stdout)


def result_of(output: str) -> dict[str, Any]:
    """Return the result in a client's output; threads of ur_rtde print their own lines."""
    lines = [line for line in output.splitlines() if line.startswith("{")]
    assert lines, f"no result: {output!r}"
    result: dict[str, Any] = json.loads(lines[-1])
    return result
