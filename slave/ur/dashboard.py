"""The dashboard server of a UR controller: one line each way, each within a time limit.

The vendor library's client has no `unlock protective stop` in Python, and its `isProgramSaved` is always false.

Source: Universal Robots, "Dashboard Server e-Series".
"""

import contextlib
import socket
import time
from typing import Final

PORT: Final = 29999
UNLOCKED: Final = "Protective stop releasing"
STOPPED: Final = "Stopped"


class DashboardError(RuntimeError):
    """The dashboard did not answer, or refused."""


def ask(host: str, *lines: str, limit_s: float = 1.0) -> list[str]:
    """The answers to some lines, over a connection of their own; all of it within a time in s.

    Raises:
        DashboardError: There is nobody, or no answer in time.
    """
    end_s = time.monotonic() + limit_s
    try:
        with socket.create_connection((host, PORT), timeout=limit_s) as connection:
            came = b""
            answers: list[str] = []
            # The first line is its greeting.
            for line in ("", *lines):
                if line:
                    connection.sendall(f"{line}\n".encode())
                while b"\n" not in came:
                    connection.settimeout(max(1e-3, end_s - time.monotonic()))
                    part = connection.recv(4096)
                    if not part:
                        raise ConnectionError("closed")
                    came += part
                answer, _, came = came.partition(b"\n")
                answers.append(answer.decode("utf-8", "replace").strip())
            with contextlib.suppress(OSError):
                connection.sendall(b"quit\n")
    except OSError as error:
        message = f"dashboard {host}:{PORT}: {error.strerror or error}"
        raise DashboardError(message) from None
    return answers[1:]


def stop_program(host: str, limit_s: float = 0.5) -> None:
    """Ends the program that plays: the second way to stop an arm.

    Raises:
        DashboardError: It did not.
    """
    (answer,) = ask(host, "stop", limit_s=limit_s)
    if answer != STOPPED:
        message = f"dashboard: stop: {answer}"
        raise DashboardError(message)


def unlock_protective_stop(host: str) -> None:
    """Unlocks a protective stop and closes what the pendant shows of it.

    Raises:
        DashboardError: The controller refuses.
    """
    answer, _ = ask(host, "unlock protective stop", "close safety popup")
    if answer != UNLOCKED:
        message = f"dashboard: unlock protective stop: {answer}"
        raise DashboardError(message)


def is_in_remote_control(host: str) -> bool:
    """Whether the controller takes scripts from outside; e-Series from 5.6 on.

    Raises:
        DashboardError: No answer.
    """
    (answer,) = ask(host, "is in remote control")
    return "true" in answer.lower()
