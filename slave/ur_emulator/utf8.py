"""Text for a client, whatever is in it."""


def utf8(text: str, most: int) -> bytes:
    """At most so many bytes of a text in UTF-8: whole characters, and escapes of what UTF-8 has not."""
    encoded = text[:most].encode("utf-8", "backslashreplace")[:most]
    return encoded.decode("utf-8", "ignore").encode()
