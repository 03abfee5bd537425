"""Server of the console: its page shows one bridge in three dimensions."""

import contextlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haptether.view.console.bodies import Bodies
from haptether.view.console.page_server import PageServer
from haptether.view.console.pair import Pair

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import BaseRoute

HERE = Path(__file__).parent
FILES = {
    "": HERE / "page.html",
    "console.js": HERE / "console.js",
    "renderer.js": HERE.parent / "page/renderer.js",
    "ends.js": HERE / "ends.js",
}


class Console(PageServer):
    """Show one or two running sides to browsers of this machine.

    Args:
        telemetry: Sockets of `--telemetry`.
        control: Sockets of `--control`; each side identifies itself.
        flight: Files of `--flight`.
        port: Port on 127.0.0.1; 0 lets the system choose.

    Raises:
        OSError: The port is in use, or there are too few descriptors.
    """

    def __init__(self, telemetry: Sequence[Path], control: Sequence[Path], *, flight: Sequence[Path] = (),
                 port: int = 0) -> None:  # fmt: skip
        self.bodies = Bodies()
        pair = Pair(telemetry=telemetry, control=control, flight=flight)
        super().__init__([pair], FILES, {"": self.bodies.take}, port=port)

    def serve(self, stopped: Callable[[], bool]) -> None:
        """Serve until `stopped` returns True; the loops of the sides are not affected."""
        self.bodies.start()
        with contextlib.closing(self.bodies):
            super().serve(stopped)

    def parts(self) -> dict[str, Any]:
        """Return flight records and the newest poses."""
        return {**super().parts(), "bodies": self.bodies.frame}

    def routes(self) -> "Iterable[BaseRoute]":
        """Return the route of the bodies' geometry."""
        from starlette.routing import Route

        return [Route("/bodies", self._geometry)]

    def watched(self, *, by_pages: bool) -> None:
        """Compute poses only while a page is open."""
        self.bodies.is_watched = by_pages

    async def _geometry(self, _: "Request") -> "Response":
        from starlette.responses import Response

        return Response(self.bodies.geometry, media_type="application/json")
