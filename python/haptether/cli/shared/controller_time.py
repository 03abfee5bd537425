"""Cost of controllers in Python, in a sentence."""

import contextlib
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@contextlib.contextmanager
def controller_timed(console: "Console", *, here: bool = True) -> Iterator[None]:
    """Print at the end how much a controller in Python, if one ran, has slowed the run.

    Args:
        console: Output.
        here: True if it ran in this process alone: the time of several workers is not a share of the elapsed time.
    """
    from haptether.bridge import controller_time

    before, begun_s = controller_time(), time.perf_counter()
    yield
    after, took_s = controller_time(), time.perf_counter() - begun_s
    ticks, seconds = after.ticks - before.ticks, after.seconds - before.seconds
    if not ticks:
        return
    line = f"controller in Python: {ticks} ticks of {1e6 * seconds / ticks:.1f} us each"
    if here and took_s > seconds:
        line += f", {seconds / took_s:.0%} of the time"
    console.print(line)
