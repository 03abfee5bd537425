"""The vendor's control interface in a process of its own, which can be killed.

Once a connection is lost, a thread of ur_rtde 1.6.5 connects again by itself, without end: each time it uploads the
control script anew, which forgets the watchdog and stops whatever plays. To disconnect, to reconnect or to destroy the
interface meanwhile ends the process with a segmentation fault, and some calls never return. So all of it runs where a
kill is the end of it and of nothing else; what the library prints goes to standard error.
"""

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

from haptether.slave.ur.priority import ask_little_realtime

PARENT_EVERY_S: Final = 0.05
LONGEST_LINE: Final = 1 << 16


class ControlProcessError(RuntimeError):
    """The library raised, or its process is gone."""


class ControlProcess:
    """Calls as on an `rtde_control.RTDEControlInterface`, for one thread at a time; `kill` ends one from another.

    Args:
        host: The controller.
        rate_hz: Of the packages that the library takes.

    It is there at once, so that it can be killed while it connects.
    """

    def __init__(self, host: str, rate_hz: float) -> None:
        self._socket, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "haptether.slave.ur.process",
                    str(theirs.fileno()),
                    host,
                    repr(rate_hz),
                    str(os.getpid()),
                ],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=2,
                # A Ctrl-C is for the bridge, which then stops the arm through this process.
                start_new_session=True,
            )
        self._lines = self._socket.makefile("rb")

    def connect(self) -> None:
        """Waits until the library has connected, and its script plays.

        Raises:
            ControlProcessError: It could not.
        """
        self._answer("connect")

    def __getattr__(self, name: str) -> Callable[..., Any]:
        """A call of the library."""
        if name.startswith("_"):
            raise AttributeError(name)
        return lambda *arguments: self._call(name, arguments)

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def kill(self) -> None:
        """Ends the process, in the middle of a call if need be, and with it its connections."""
        self._process.kill()
        # Whoever waits for an answer wakes up.
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        threading.Thread(target=self._leave, daemon=True).start()

    def _leave(self) -> None:
        self._process.wait()
        self._lines.close()
        self._socket.close()

    def _call(self, name: str, arguments: tuple[Any, ...]) -> Any:  # noqa: ANN401  # what the library gives
        try:
            self._socket.sendall(json.dumps((name, arguments)).encode() + b"\n")
        except OSError:
            raise self._gone(name) from None
        return self._answer(name)

    def _answer(self, name: str) -> Any:  # noqa: ANN401
        try:
            line = self._lines.readline(LONGEST_LINE)
        except (OSError, ValueError):
            line = b""
        if not line:
            raise self._gone(name)
        error, result = json.loads(line)
        if error is not None:
            raise ControlProcessError(error)
        return result

    def _gone(self, name: str) -> ControlProcessError:
        status = self._process.poll()
        ended = f"ended with {status}" if status is not None else "is gone"
        return ControlProcessError(f"the process of ur_rtde {ended} during {name}")


def main() -> None:
    """What the process does: one call after another, until nobody asks any more."""
    descriptor, host, rate, parent = sys.argv[1:]
    ask_little_realtime()
    # Given, and not asked for: whoever began this process may have ended by now.
    threading.Thread(target=_end_with, args=(int(parent),), daemon=True).start()
    with socket.socket(fileno=int(descriptor)) as asked:
        lines = asked.makefile("rb")

        def answer(error: str | None, result: object = None) -> None:
            asked.sendall(json.dumps((error, result)).encode() + b"\n")

        interface = import_module("rtde_control").RTDEControlInterface
        try:
            # An external force sensor through RTDE does not work in this library, and another client may have one.
            control = interface(host, float(rate), interface.FLAG_UPLOAD_SCRIPT | interface.FLAG_NO_EXT_FT)
        except Exception as error:  # of the library: told to whoever asked
            answer(str(error))
            os._exit(1)
        answer(None)
        for line in lines:
            name, arguments = json.loads(line)
            try:
                result = getattr(control, name)(*arguments)
            except Exception as error:
                answer(str(error))
            else:
                answer(None, result)
    # Its destructor would wait, or worse.
    os._exit(0)


def _end_with(parent: int) -> None:
    """Ends this process with the one that began it, also in the middle of a call."""
    while os.getppid() == parent:
        time.sleep(PARENT_EVERY_S)
    os._exit(0)


if __name__ == "__main__":
    main()
