"""The remedy for an address that another process holds."""

import errno
import re

LISTENING = ("listen", "control", "port", "event_port", "gripper_port", "tcp", "host")
"""Options that name an address to listen on."""
PORT = re.compile(r"[:,] ?(\d{1,5})(?![\d\].])")
"""A port after its host, as in 127.0.0.1:9000, [::1]:9000 and ('127.0.0.1', 9000)."""


def busy_port_remedy(error: Exception, command: object) -> str:
    """Return who may hold a busy port, how to find out, and which option names another.

    Empty for any other error.
    """
    text = str(error)
    if not isinstance(error, OSError) or not (error.errno == errno.EADDRINUSE or "Address already in use" in text):
        return ""
    if not (ports := PORT.findall(text)):
        return ""
    port = ports[-1]
    given = {name: str(value) for name in LISTENING if (value := getattr(command, name, None)) is not None}
    # A host without a port stands for ports that the protocol fixes.
    named = [name for name, value in given.items() if value.rpartition(":")[2] == port] or ["host"] * ("host" in given)
    option = "".join(f", or give another --{name.replace('_', '-')}" for name in named[:1])
    return (
        ": a process has this port, perhaps a haptether command that still runs in another terminal:"
        f" `ss -lntup 'sport = :{port}'` names it; end it{option}"
    )
