"""Files that a link names: read relative to its scene and embedded."""

from pathlib import Path

from msgspec.structs import replace

from haptether.netsim.link_error import LinkError
from haptether.netsim.link_settings import LinkSettings
from haptether.netsim.link_spec import Direction

LARGEST_FILE = 256 * 2**20
"""In bytes; a recording of a day at 1 kHz is larger and needs to be thinned out."""


def with_files(settings: LinkSettings, folder: Path, direction: Direction) -> LinkSettings:
    """The settings with the contents of the files that they name, relative to `folder`."""
    return settings
