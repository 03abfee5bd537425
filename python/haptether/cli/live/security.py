"""`--key` and `--insecure` of the live commands."""

from pathlib import Path

INSECURE = "INSECURE: frames are neither encrypted nor authenticated, anybody who can send can steer"
"""What the screen says of a run in the clear."""


def session_key(key: Path | None, *, insecure: bool) -> bytearray | None:
    """The key of a secure session, or none for a run in the clear.

    Raises:
        ValueError: Both or neither were asked for, or the file cannot be read or holds no key.
    """
    from haptether.bridge import read_key

    if insecure and key is not None:
        message = "--key, --insecure: give one of the two"
        raise ValueError(message)
    if insecure:
        return None
    if key is None:
        message = (
            "--key PATH is missing: `haptether keygen PATH` makes a key, which both sides need; "
            "--insecure goes without, in the clear"
        )
        raise ValueError(message)
    try:
        return read_key(key)
    except OSError as error:
        message = (
            f"--key {key}: cannot be read: {error.strerror}: must be a key file, the same at both sides; "
            "`haptether keygen PATH` makes one"
        )
        raise ValueError(message) from None


def handed_over(key: bytearray | None) -> None:
    """Wipes a key that the live side has its copy of."""
    from haptether.bridge import wipe_key

    if key is not None:
        wipe_key(key)


def marked(headline: str, *, insecure: bool) -> str:
    """A headline that says so if the run is in the clear."""
    return f"{headline} ({INSECURE})" if insecure else headline
