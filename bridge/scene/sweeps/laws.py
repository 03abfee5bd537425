"""Distributions of a sampled field: laws of one number, quantiles, draws and Sobol points."""

import csv
import importlib
import importlib.util
import io
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from math import inf, isfinite, log, log1p, sqrt
from os import PathLike
from pathlib import Path
from statistics import NormalDist
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from haptether.bridge.scene.errors import shown
from haptether.extras import require
from haptether.input_file import read_text

Array: TypeAlias = npt.NDArray[np.float64]

FORMS = (
    "uniform:a:b with a < b, loguniform:a:b with 0 < a < b, normal:mean:deviation or lognormal:mean:deviation with a"
    " deviation above 0, quantiles:p=v:p=v with p that rise from 0 to 1 and v that do not fall, or"
    " measured:FILE.csv:COLUMN"
)
"""Text form of each law."""
MOST_MEASURED = 1_000_000
"""Largest number of measurements read from a file."""


@dataclass(frozen=True)
class SampleLaw:
    """Distribution of one number.

    - uniform a, b: x = a + (b - a) u
    - loguniform a, b: x = a (b / a)^u
    - normal m, s: x = m + s z
    - lognormal m, s: x = exp(mu + sigma z), sigma² = ln(1 + s² / m²), mu = ln m - sigma² / 2: its mean is m and its
      standard deviation s
    - quantiles p_0, v_0, ..., p_n, v_n: piecewise linear through the points (p_i, v_i), u uniform between p_0 and p_n:
      values beyond the outer quantiles are not drawn
    - constant v: x = v

    u is uniform between 0 and 1, z standard normal.

    Source: Devroye 1986, II.2 (inversion); Johnson, Kotz and Balakrishnan 1994, 14.3 (moments of the lognormal law).
    """

    name: str
    """One of the names above."""
    numbers: tuple[float, ...]
    """Parameters in order."""

    @property
    def support(self) -> tuple[float, float]:
        """Return the smallest and the largest possible value."""
        if self.name == "normal":
            return -inf, inf
        if self.name == "lognormal":
            return 0.0, inf
        return (self.numbers[1], self.numbers[-1]) if self.name == "quantiles" else (self.numbers[0], self.numbers[-1])

    def quantile(self, share: Array) -> Array:
        """Return the quantiles x for probabilities `share` in [0, 1], of any shape."""
        if self.name in {"normal", "lognormal"}:
            unit = np.clip(share, 0.5**53, 1.0 - 0.5**53)
            return self._of_normal(np.array([NormalDist().inv_cdf(one) for one in unit.tolist()]))
        first, last = self.numbers[0], self.numbers[-1]
        if self.name == "uniform":
            return first + (last - first) * share
        if self.name == "loguniform":
            return np.asarray(np.exp(log(first) + log(last / first) * share), dtype=np.float64)
        if self.name == "constant":
            return np.full(np.shape(share), first)
        shares, values = np.array(self.numbers[::2]), np.array(self.numbers[1::2])
        return np.asarray(np.interp(shares[0] + (shares[-1] - shares[0]) * share, shares, values), dtype=np.float64)

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Return `count` independent values; a larger count begins with the same values."""
        if self.name in {"normal", "lognormal"}:
            return self._of_normal(rng.standard_normal(count))
        return self.quantile(rng.random(count))

    def _of_normal(self, standard: Array) -> Array:
        mean, deviation = self.numbers
        if self.name == "normal":
            return mean + deviation * standard
        variance = log1p((deviation / mean) ** 2)
        return np.asarray(np.exp(log(mean) - 0.5 * variance + sqrt(variance) * standard), dtype=np.float64)


def law_of(text: str, folder: Path | None = None) -> SampleLaw:
    """Parse `name:number:number`, `quantiles:p=v:p=v:...` or `measured:FILE.csv:COLUMN`.

    Args:
        text: One of these forms.
        folder: Base folder of file paths; by default the working directory.

    Raises:
        ValueError: Another form, invalid parameters, or a file without such a numeric column.
    """
    name, _, rest = text.partition(":")
    if name == "measured":
        path, _, column = rest.rpartition(":")
        if path and column:
            return measured_law(path if folder is None else folder / path, column)
        message = f"{shown(text)}: must be measured:FILE.csv:COLUMN"
        raise ValueError(message)
    parts = rest.split(":")
    try:
        if name == "quantiles":
            numbers = [float(number) for part in parts for number in _pair(part)]
        else:
            numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if not _holds(name, numbers):
        message = f"{shown(text)}: must be {FORMS}"
        raise ValueError(message)
    return SampleLaw(name, tuple(numbers))


def _pair(part: str) -> Sequence[str]:
    pair = part.split("=")
    if len(pair) != 2:
        raise ValueError
    return pair


def _holds(name: str, numbers: Sequence[float]) -> bool:
    """Return True if the parameters are valid for the law."""
    if not all(map(isfinite, numbers)):
        return False
    if name == "quantiles":
        shares, values = numbers[::2], numbers[1::2]
        inside = len(shares) > 1 and shares[0] >= 0.0 and shares[-1] <= 1.0
        return inside and all(np.diff(shares) > 0.0) and all(np.diff(values) >= 0.0)
    if len(numbers) != 2:
        return False
    first, second = numbers
    return {
        "uniform": first < second,
        "loguniform": 0.0 < first < second,
        "normal": second > 0.0,
        "lognormal": first > 0.0 and second > 0.0,
    }.get(name, False)


def measured_law(path: str | PathLike[str], column: str) -> SampleLaw:
    """Return the empirical law of a CSV column, with linear interpolation between quantiles.

    The i-th of n sorted values, counted from 0, is quantile i / (n - 1).

    Raises:
        ValueError: The file cannot be read, has no such column, has a row that is not a finite number, or has fewer
            than two rows.

    Source: Hyndman and Fan 1996, definition 7.
    """
    try:
        rows = csv.DictReader(io.StringIO(read_text(path), newline=""))
        columns = rows.fieldnames or ()
        if column not in columns:
            # The file may be secret, so show none of its content but a name close to the requested one.
            near = get_close_matches(column, columns, n=1)
            hint = f"did you mean {near[0]}?" if near else "is the first line its header, with commas between names?"
            message = f"its header has {len(columns)} columns and no {column!r}: {hint}"
            raise ValueError(message)
        values = []
        for row in rows:
            if None in row:
                message = f"line {rows.line_num}: more cells than the header has: decimals take a point, cells a comma"
                raise ValueError(message)
            values.append(_finite(column, rows.line_num, row[column]))
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise ValueError(message) from None
    except (ValueError, csv.Error) as error:
        message = f"{path}: {error}"
        raise ValueError(message) from None
    if not 2 <= len(values) <= MOST_MEASURED:
        message = f"{path}: {len(values)} rows: must be 2 to {MOST_MEASURED} measurements"
        raise ValueError(message)
    points = zip(np.linspace(0.0, 1.0, len(values)).tolist(), sorted(values), strict=True)
    return SampleLaw("quantiles", tuple(number for point in points for number in point))


def _finite(column: str, line: int, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = inf
    if not isfinite(value):
        message = f"line {line}: {column} = {shown(text or '')}: must be a finite number"
        raise ValueError(message)
    return value


def generator(seed: int, name: str) -> np.random.Generator:
    """Return the random generator of one quantity; it depends only on seed and name."""
    return np.random.default_rng([seed, *name.encode()])


def sobol_points(names: Iterable[str], count: int, seed: int) -> dict[str, Array]:
    """Return points of a scrambled Sobol sequence between 0 and 1, one dimension per name.

    Raises:
        ValueError: No name is given.
        ImportError: SciPy is not installed.

    Source: Owen 1998 (scrambling); Joe and Kuo 2008 (direction numbers).
    """
    names = tuple(names)
    if not names:
        message = "--sobol: give --draw or --population, what is drawn"
        raise ValueError(message)
    require("--sobol", "scipy")
    qmc = importlib.import_module("scipy.stats.qmc")
    with warnings.catch_warnings():
        # Warning for a count that is not a power of two; the help mentions it.
        warnings.simplefilter("ignore", UserWarning)
        points = qmc.Sobol(len(names), scramble=True, rng=np.random.default_rng(seed)).random(count)
    return {name: np.clip(points[:, place], 0.5**53, 1.0 - 0.5**53) for place, name in enumerate(names)}
