"""Text of files, of the network and of drivers, as a screen may have it."""


def printable(text: str) -> str:
    """The text with all that no screen shows (control characters, escapes, marks of direction) as its escape."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
