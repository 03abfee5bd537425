"""Packets at a constant rate and the table of their fates, for `sample` and `compare`."""

from typing import TYPE_CHECKING

from haptether.cli.shared.table import Column, Rows

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from haptether.netsim import LinkFigures

MAX_PACKETS = 50_000_000


def check_traffic(packets: int, rate_hz: float, size: int) -> None:
    """Refuse packets that nobody can send.

    Raises:
        ValueError: A value out of its bounds; the message names them.
    """
    for key, seen, low, high in (
        ("packets", packets, 1, MAX_PACKETS),
        ("rate", rate_hz, 1e-3, 1e9),
        ("size", size, 0, 65_535),
    ):
        if not low <= seen <= high:
            message = f"{key} = {seen:g}: must be {low:g} to {high:g}"
            raise ValueError(message)


def sending_times(packets: int, rate_hz: float) -> "npt.NDArray[np.int64]":
    """Return the sending times of packets at a constant rate, in ns."""
    import numpy as np

    times: npt.NDArray[np.int64] = np.rint(np.arange(packets) * (1e9 / rate_hz)).astype(np.int64)
    return times


MILLISECONDS = {"mean_s": "mean delay", "sigma_s": "sigma", "p50_s": "p50", "p99_s": "p99"}
SHARES = {"loss": "loss", "reordered": "reordered", "duplicates": "duplicates", "damaged": "damaged"}


def shown(name: str, value: float | None) -> str:
    """Return a figure with its unit, "-" for an unknown one."""
    if value is None:
        return "-"
    if name in MILLISECONDS:
        return f"{value * 1e3:.3f} ms"
    return f"{value * 100:.4g} %" if name in SHARES else f"{value:.3f}"


def figures_table(title: str, columns: "dict[str, LinkFigures]") -> Rows:
    """Return a table with a row per figure and a column per set of figures."""
    table = Rows(title, *(Column(name, numbers=True) for name in columns))
    for name, label in {**MILLISECONDS, "loss": "loss", "mean_burst": "mean burst", **SHARES}.items():
        table.add(label, *(shown(name, getattr(figures, name)) for figures in columns.values()))
    return table
