"""A vendor's shared library, found at run time: it is not ours to ship."""

import ctypes
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from haptether.checklist import Checklist, RefusedError


class Function(NamedTuple):
    """A function of a library, as the vendor's header has it."""

    name: str
    result: Any
    """Its type, of ctypes; none for void."""
    arguments: tuple[Any, ...] = ()


class Vendor(NamedTuple):
    """Where the library of a vendor may be, and what to do where it is not."""

    title: str
    names: tuple[str, ...]
    """As the system's loader knows it, the best first."""
    variable: str
    """The environment variable that names the folder of the vendor's kit."""
    below: tuple[str, ...]
    """Patterns of the library below that folder."""
    places: tuple[str, ...]
    """Patterns of files where the vendor's installers put it."""
    remedy: str


def load_library(vendor: Vendor, path: str, functions: Sequence[Function], checklist: Checklist) -> ctypes.CDLL:
    """The library, with the types of its functions.

    Args:
        vendor: Whose library.
        path: The option `library`: this file and no other; empty to look for one.
        functions: What it must have.
        checklist: Gets the line.

    Raises:
        RefusedError: It is nowhere, cannot be loaded, or lacks a function; says where it was looked for.
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
    raise RefusedError  # `finish` has


def _candidates(vendor: Vendor) -> Iterator[str]:
    folder = os.environ.get(vendor.variable)
    if folder:
        for pattern in vendor.below:
            yield from _found(str(Path(folder) / pattern)) or [str(Path(folder) / pattern)]
    yield from vendor.names
    for place in vendor.places:
        yield from _found(place)


def _found(pattern: str) -> list[str]:
    """Files of a pattern, the newest version first."""
    path = Path(pattern).expanduser()
    return sorted(map(str, Path(path.anchor).glob(str(path.relative_to(path.anchor)))), reverse=True)


def _why(candidate: str, error: OSError) -> str:
    """The loader's own words where they say more than that there is none."""
    text = str(error)
    return candidate if "No such file" in text and candidate in text else f"{candidate} ({text})"
