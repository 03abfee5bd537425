"""Progress of a command on standard error, shown once it takes long."""

import contextlib
from collections.abc import Callable, Iterator

AFTER_S = 2.0


@contextlib.contextmanager
def counted(text: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar beside the text after two seconds; yield a function that takes the finished and the total count."""
    import threading

    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from haptether.cli.shared.screen import Screen

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=Screen(stderr=True))
    task = bar.add_task(text, total=None)
    timer = threading.Timer(AFTER_S, bar.start)
    timer.daemon = True
    timer.start()
    try:
        yield lambda done, of: bar.update(task, completed=done, total=of)
    finally:
        timer.cancel()
        timer.join()
        # A bar that was never shown would leave an empty line.
        if bar.live.is_started:
            bar.stop()
