"""Printable form of text from files, the network and drivers."""


def printable(text: str) -> str:
    """Replace unprintable characters (control characters, escapes, direction marks) by escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
