"""A picture in a window: it is drawn anew, looked at from elsewhere, resized, and closed."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Final

from haptether.view.picture.cameras import CAMERAS
from haptether.view.picture.picture import Picture
from haptether.view.scene3d import colours
from haptether.view.scene3d.description import Description

TIMER_MS: Final = 15
"""Between two looks at the clock; what is drawn in between is what the machine manages, 30 a second or more."""
LEAST_PIXELS = 100


class Window(ABC):
    """A picture that is shown, and what every window listens to.

    Args:
        described: Runs, side by side.
        size: Width and height in pixels.
        camera: One of `CAMERAS`.

    Raises:
        NoGlError: No display, or no OpenGL.
    """

    keys: ClassVar[Sequence[tuple[str, str]]]
    """What it listens to, and what that does."""

    def __init__(self, described: Sequence[Description], *, size: tuple[int, int], camera: str) -> None:
        self.picture = Picture(described, size=size, camera=camera, window=True)
        self.is_closed = False
        """Whether somebody ended it."""
        self._help = False
        self._listen()

    def show(self) -> None:
        """Until it is closed."""
        self.draw()
        self.picture.plotter.show(title=self.picture.described[0].title, interactive_update=False, auto_close=True)

    @abstractmethod
    def update(self) -> None:
        """Puts everything where it is at the time that is shown."""

    @abstractmethod
    def tick(self) -> None:
        """What the timer does."""

    def click(self, x: int, y: int) -> None:  # noqa: B027  # what has no time line needs none
        """At a pixel from the lower left."""

    def press(self, key: str) -> bool:
        """What a key does; one that is not of `keys` nothing, which is returned."""
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
        """Shows what is now."""
        self.update()
        self.picture.plotter.render()

    def close(self) -> None:
        """Ends it."""
        self.is_closed = True
        self.picture.plotter.iren.terminate_app()

    def _listen(self) -> None:
        plotter = self.picture.plotter
        interactor = plotter.iren.interactor
        plotter.iren.initialize()
        self.picture.keep_up()
        # Some of VTK's own keys would end the window or draw wires.
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
