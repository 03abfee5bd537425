"""What shows a run: telemetry, recordings and scenes in; panels, pictures, films and pages out. No loop imports it.

`describe` computes what is where, without any library that draws; `Picture` draws it with PyVista, `write_page` makes
a page of it that needs nothing else. The extra `view` brings the libraries.
"""

from haptether.view.scene3d.description import Description, NothingRecordedError, describe, describe_beside
from haptether.view.terminal.panel import headline, panel
from haptether.view.terminal.state import Observer, SideState

__all__ = [
    "Description",
    "NothingRecordedError",
    "Observer",
    "SideState",
    "describe",
    "describe_beside",
    "headline",
    "panel",
]
