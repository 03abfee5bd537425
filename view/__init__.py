"""Display of runs: panels, pictures, films and pages from telemetry, recordings and scenes.

No loop imports this room. `describe` computes all poses without a graphics library, `LiveDescription` does so for a
live run. `Picture` draws them with PyVista; `write_page` writes a self-contained page. The extra `view` installs the
libraries. Names load on first use, so that drawing a figure loads no scenes.
"""

from typing import TYPE_CHECKING

from haptether.lazy_names import lazy_names

if TYPE_CHECKING:
    from haptether.view.scene3d.description import Description, Moment, NothingRecordedError, describe, describe_beside
    from haptether.view.scene3d.live import LiveDescription
    from haptether.view.style.figure import picture_style
    from haptether.view.terminal.panel import headline, panel
    from haptether.view.terminal.state import Observer, SideState

__all__ = [
    "Description",
    "LiveDescription",
    "Moment",
    "NothingRecordedError",
    "Observer",
    "SideState",
    "describe",
    "describe_beside",
    "headline",
    "panel",
    "picture_style",
]

if not TYPE_CHECKING:  # otherwise a type checker would accept any name
    __getattr__, __dir__ = lazy_names(__name__)
