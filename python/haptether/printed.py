"""Texts that stand on standard error already: a later line says `see above` instead of a fault or refusal."""

from collections import deque

SEE_ABOVE = "see above"
MIN_CHARACTERS = 8
"""Length of the shortest text that is replaced; a shorter one may be a part of any text."""
_PRINTED: deque[str] = deque(maxlen=64)


def printed(text: str) -> str:
    """Note that a text is printed now; return it."""
    if len(text) >= MIN_CHARACTERS and text not in _PRINTED:
        _PRINTED.append(text)
    return text


def shortened(text: str) -> str:
    """Replace what was printed before, the longest texts first."""
    for part in sorted(_PRINTED, key=len, reverse=True):
        text = text.replace(part, SEE_ABOVE)
    return text


def forget() -> None:
    """Forget all texts: a new command begins, or its screen was lost."""
    _PRINTED.clear()
