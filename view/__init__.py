"""Displays of runs: telemetry, recordings and scenes in; panels, pictures, films and pages out.

No loop imports this package. `describe` computes the poses of all bodies without a drawing library; `LiveDescription`
does so for a live run. `Picture` draws with PyVista; `write_page` makes a self-contained page. The extra `view`
installs the libraries. Names load lazily: drawing a figure does not load scenes.
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

if not TYPE_CHECKING:  # otherwise type checkers accept any name
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "scene3d.description": ("Description", "Moment", "NothingRecordedError", "describe", "describe_beside"),
            "scene3d.live": ("LiveDescription",),
            "terminal.panel": ("headline", "panel"),
            "terminal.state": ("Observer", "SideState"),
        },
    )
