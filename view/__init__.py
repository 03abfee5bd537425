"""What shows a run: telemetry, recordings and scenes in; panels, pictures, films and pages out. No loop imports it.

`describe` computes what is where, without any library that draws, and `LiveDescription` that of a run that goes on;
`Picture` draws it with PyVista, `write_page` makes a page of it that needs nothing else. The extra `view` brings the
libraries. A name is loaded when it is asked for: who draws a figure in the style of the project loads no scenes.
"""

from typing import TYPE_CHECKING

from haptether.lazy_names import lazy_names

if TYPE_CHECKING:
    from haptether.view.scene3d.description import Description, Moment, NothingRecordedError, describe, describe_beside
    from haptether.view.scene3d.live import LiveDescription
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
]

if not TYPE_CHECKING:  # else any name would do
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "scene3d.description": ("Description", "Moment", "NothingRecordedError", "describe", "describe_beside"),
            "scene3d.live": ("LiveDescription",),
            "terminal.panel": ("headline", "panel"),
            "terminal.state": ("Observer", "SideState"),
        },
    )
