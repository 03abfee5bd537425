"""A picture in a window: redraws, camera, resizing, closing."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Final

from haptether.view.picture.cameras import CAMERAS
from haptether.view.picture.picture import Picture
from haptether.view.scene3d import colours
from haptether.view.scene3d.description import Description

TIMER_MS: Final = 15
"""Period of timer events; the frame rate depends on the machine, 30 per second or more."""
LEAST_PIXELS = 100


class Window(ABC):
    """A picture in a window, with the keys and actions of every window.

    Args:
        described: Runs, side by side.
        size: Width and height in pixels.
        camera: One of `CAMERAS`.

    Raises:
        NoGlError: There is no display, or no OpenGL.
    """

    keys: ClassVar[Sequence[tuple[str, str]]]
    """Keys and actions with their effects."""

    def __init__(self, described: Sequence[Description], *, size: tuple[int, int], camera: str) -> None:
        self.picture = Picture(described, size=size, camera=camera, window=True)
        self.is_closed = False
        """True if the user closed it."""
        self._help = False
        self._listen()

    def show(self) -> None:
        """Show the window until it is closed."""
        self.draw()
        self.picture.plotter.show(title=self.picture.described[0].title, interactive_update=False, auto_close=True)

    @abstractmethod
    def update(self) -> None:
        """Move everything to its pose at the current time."""

    @abstractmethod
    def tick(self) -> None:
        """Handle a timer event."""

    def click(self, x: int, y: int) -> None:  # noqa: B027  # optional: not every window has a time line
        """Handle a click at a pixel from the lower left."""

    def press(self, key: str) -> bool:
        """Handle a key; return False if it is not one of `keys`."""
        if key in {"1", "2", "3", "4"}:
            self.picture.look(list(CAMERAS)[int(key) - 1])
        elif key == "question":
            self._help = not self._help
            self._show_help()
        elif key in {"q", "Escape"}:
            self.close()
            return True
        else:
            return False
        self.draw()
        return True

    def draw(self) -> None:
        """Update and render."""
        self.update()
        self.picture.plotter.render()

    def close(self) -> None:
        """Close the window."""
        self.is_closed = True
        self.picture.plotter.iren.terminate_app()

    def _listen(self) -> None:
        plotter = self.picture.plotter
        interactor = plotter.iren.interactor
        plotter.iren.initialize()
        self.picture.keep_up()
        # Some of VTK's own keys would close the window or draw wireframes.
        interactor.RemoveObservers("CharEvent")
        plotter.iren.add_observer("KeyPressEvent", lambda *_: self.press(interactor.GetKeySym()))
        plotter.iren.add_observer("TimerEvent", lambda *_: self.tick())
        plotter.iren.add_observer("LeftButtonPressEvent", lambda *_: self.click(*interactor.GetEventPosition()))
        plotter.render_window.AddObserver("ModifiedEvent", lambda *_: self._resize())
        interactor.CreateRepeatingTimer(TIMER_MS)

    def _resize(self) -> None:
        size = tuple(self.picture.plotter.render_window.GetSize())
        if size != self.picture.size and min(size) > LEAST_PIXELS:
            self.picture.lay_out((size[0], size[1]))

    def _show_help(self) -> None:
        plotter = self.picture.plotter
        plotter.subplot(0, 0)
        text = "\n".join(f"{key:<22}{does}" for key, does in self.keys) if self._help else ""
        plotter.add_text(text, position="upper_left", font_size=11, color=colours.INK, font="courier", name="keys")
