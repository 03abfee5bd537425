"""What a run is seen in: recordings and telemetry in, pictures and pages out. No loop imports it."""

from haptether.view.terminal.panel import headline, panel
from haptether.view.terminal.state import Observer, SideState

__all__ = ["Observer", "SideState", "headline", "panel"]
