"""Colours of controllers and of the paper, equal in all figures and distinguishable by the colour-blind.

Source: M. Okabe, K. Ito, "Color Universal Design", 2008. Lines also differ in
their dashes, or in their markers.
"""

from collections.abc import Iterable
from itertools import chain
from typing import Any

from haptether import _core
from haptether.view.scene3d.colours import COMMANDED, DEVICE_FORCE, ENVIRONMENT_FORCE, HAND_FORCE

LOOKS: tuple[tuple[str, Any], ...] = (
    ("#e69f00", "-."),
    ("#0072b2", "--"),
    ("#009e73", "-"),
    ("#cc79a7", (0, (5, 1, 1, 1, 1, 1))),
)
"""Colours and dashes of the first controllers of the registry; further ones repeat the colours, dotted."""
CONTROLLERS: dict[str, tuple[str, Any]] = {
    "none": ("#d55e00", "-"),
    **dict(zip((name for name, _, _ in _core.CONTROLLERS),
               chain(LOOKS, ((colour, (0, (1, 2))) for colour, _ in LOOKS)), strict=False)),
}  # fmt: skip
"""Colour and dashes of each controller, and of a run without one."""
UNION = "#56b4e9"
"""Colour of several controllers at once; the dashes identify them."""
UNION_DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 3)))
RESEARCH = "#8c564b"
"""Colour of runs with a Python controller; the dashes identify the others."""
PAPER = "#000000"
"""Colour of values read from the paper."""
THRESHOLD = "#7f7f7f"
"""Colour of thresholds and theoretical values."""
HELD = "#999999"
"""Colour of an intervention in hold-off."""

SIGNALS = {
    "hand": DEVICE_FORCE,
    "arm": ENVIRONMENT_FORCE,
    "commanded": COMMANDED,
    "rendered": "#7a8794",
    "of the hand": HAND_FORCE,
}
"""Colours of positions and forces, same as in `haptether view`."""
AXES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""Colours of x, y, z and of joints."""

FOUND = "#6a3d9a"
"""Colour of what a command found, such as a threshold."""
NEUTRAL = "#39434e"
"""Colour of a line that is the only one of its panel."""
MISSING = "#7a828c"
"""Colour of what was not measured."""
CHOICES = (
    ("#332288", "o"), ("#cc6677", "s"), ("#44aa99", "^"), ("#999933", "D"), ("#aa4499", "v"), ("#88ccee", "P"),
    ("#882255", "X"),
)  # fmt: skip
"""Colours and markers of other choices than controllers, whose colours differ. Source: P. Tol, "Colour schemes", 2021.
"""


def layered(place: int, count: int) -> dict[str, Any]:
    """Return width and marker size of a line out of several: those drawn first are thicker, and show below others."""
    below = (count - 1 - place) * min(0.7, 2.1 / max(1, count - 1))
    return {"lw": 1.0 + below, "ms": 2.6 + 1.7 * below}


def controller_look(controllers: str | Iterable[str]) -> dict[str, Any]:
    """Return `color` and `linestyle` of a run with these controllers; none is a run without one.

    A name that is not built in denotes a Python controller.
    """
    given = controllers.split("+") if isinstance(controllers, str) else list(controllers)
    names = sorted({name for name in given if name in CONTROLLERS and name != "none"}, key=list(CONTROLLERS).index)
    if any(name not in CONTROLLERS for name in given):
        mask = sum(1 << (list(CONTROLLERS).index(name) - 1) for name in names)
        return {"color": RESEARCH, "linestyle": UNION_DASHES[mask % len(UNION_DASHES)]}
    names = names or ["none"]
    if len(names) == 1:
        colour, dashes = CONTROLLERS[names[0]]
        return {"color": colour, "linestyle": dashes}
    order = list(CONTROLLERS)
    mask = sum(1 << (order.index(name) - 1) for name in names)
    unions = [number for number in range(1 << (len(order) - 1)) if number.bit_count() > 1]
    return {"color": UNION, "linestyle": UNION_DASHES[unions.index(mask) % len(UNION_DASHES)]}


def controller_title(controllers: str | Iterable[str]) -> str:
    """Return the legend text of a run with these controllers."""
    names = controllers.split("+") if isinstance(controllers, str) else list(controllers)
    titles = [name.upper() if name in CONTROLLERS else name for name in names if name != "none"]
    return " + ".join(titles) or "no controller"
