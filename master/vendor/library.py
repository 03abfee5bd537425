"""Vendor's shared library, found at run time because it cannot be shipped."""

import ctypes
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from haptether.checklist import Checklist, RefusedError


class Function(NamedTuple):
    """Library function as in the vendor's header."""

    name: str
    result: Any
    """Result type of ctypes; None for void."""
    arguments: tuple[Any, ...] = ()


class Vendor(NamedTuple):
    """Search locations of a vendor's library, and the remedy if it is missing."""

    title: str
    names: tuple[str, ...]
    """Names for the system loader, the best first."""
    variable: str
    """Environment variable with the folder of the vendor's kit."""
    below: tuple[str, ...]
    """Library patterns below that folder."""
    places: tuple[str, ...]
    """File patterns of the vendor's installers."""
    remedy: str


def load_library(vendor: Vendor, path: str, functions: Sequence[Function], checklist: Checklist) -> ctypes.CDLL:
    """Load the library and set the types of its functions.

    Args:
        vendor: Vendor of the library.
        path: Option `library`: exactly this file; empty to search.
        functions: Required functions.
        checklist: Takes the line.

    Raises:
        RefusedError: The library is missing, cannot be loaded, or lacks a function; lists the searched locations.
    """
    tried = []
    for candidate in [path] if path else _candidates(vendor):
        try:
            library = ctypes.CDLL(candidate)
        except OSError as error:
            tried.append(_why(candidate, error))
            continue
        lacking = [function.name for function in functions if not hasattr(library, function.name)]
        if lacking:
            checklist.refuse("library", f"{candidate} has no {', '.join(lacking)}", vendor.remedy)
            checklist.finish()
        for name, result, arguments in functions:
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
        checklist.ok("library", candidate)
        return library
    if not path:
        tried += [place for place in vendor.places if not _found(place)]
        if vendor.variable not in os.environ:
            tried.append(f"{vendor.variable} is not set")
    checklist.refuse("library", f"no {vendor.title}: looked for {'; '.join(tried)}", vendor.remedy)
    checklist.finish()
    raise RefusedError  # raised by `finish`


def _candidates(vendor: Vendor) -> Iterator[str]:
    folder = os.environ.get(vendor.variable)
    if folder:
        for pattern in vendor.below:
            yield from _found(str(Path(folder) / pattern)) or [str(Path(folder) / pattern)]
    yield from vendor.names
    for place in vendor.places:
        yield from _found(place)


def _found(pattern: str) -> list[str]:
    """Return the files of a pattern, the latest version first."""
    path = Path(pattern).expanduser()
    return sorted(map(str, Path(path.anchor).glob(str(path.relative_to(path.anchor)))), reverse=True)


def _why(candidate: str, error: OSError) -> str:
    """Return the loader's text if it says more than that the file is missing."""
    text = str(error)
    return candidate if "No such file" in text and candidate in text else f"{candidate} ({text})"
