"""Files that a link names: read relative to its scene and embedded."""

from pathlib import Path
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from haptether import _core
from haptether.netsim.link.errors import LinkError, wrong
from haptether.netsim.link.parts import DelayTrace, DistributionTable, Opportunities
from haptether.netsim.link.settings import DISTRIBUTIONS, Direction, LinkSettings

LARGEST_FILE = 256 * 2**20
"""In bytes; a longer recording needs to be cut or thinned out."""

_Setting = TypeVar("_Setting")


def with_files(settings: LinkSettings, folder: Path, direction: Direction) -> LinkSettings:
    """The settings with the contents of the files that they name, relative to `folder`.

    Raises:
        LinkError: A file that cannot be read, with line and column, or one that is named beside numbers.
    """
    trace, opportunities, distribution = settings.trace, settings.opportunities, settings.distribution
    if trace is not None and trace.file is not None:
        if trace.time_s is not None or trace.delay_s is not None:
            raise LinkError("trace.file", ": either file, or time_s and delay_s")
        form = trace.format or ("irtt" if trace.file.endswith(".json") else "csv")
        read = _read("trace.file", folder / trace.file, form, trace.direction or direction, DelayTrace)
        trace = replace(read, interpolate=trace.interpolate, repeat=trace.repeat)
    if opportunities is not None and opportunities.file is not None:
        if opportunities.time_ms is not None:
            raise LinkError("opportunities.file", ": either file, or time_ms")
        file = folder / opportunities.file
        opportunities = _read("opportunities.file", file, "mahimahi", direction, Opportunities)
    if isinstance(distribution, str) and distribution not in DISTRIBUTIONS:
        if not distribution.endswith(".dist"):
            raise wrong("distribution", distribution, f"one of {', '.join(DISTRIBUTIONS)}, or a .dist file")
        distribution = _read("distribution", folder / distribution, "dist", direction, DistributionTable)
    return replace(settings, trace=trace, opportunities=opportunities, distribution=distribution)


def _read(key: str, file: Path, form: str, direction: Direction, setting: type[_Setting]) -> _Setting:
    try:
        size = file.stat().st_size
        if size > LARGEST_FILE:
            raise LinkError(key, f": {file}: {size} bytes: must be at most {LARGEST_FILE}")
        if not file.is_file():
            raise LinkError(key, f": {file}: is no file")
        return msgspec.json.decode(_core.read_link_file(form, file.read_bytes(), direction), type=setting)
    except OSError as error:
        raise LinkError(key, f": {file}: cannot be read: {error.strerror}") from None
    except LinkError:
        raise
    except ValueError as error:
        raise LinkError(key, f": {file}: {error}") from None
