"""Uncertainty of a mean over seeds."""

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def student_quantile(degrees: int) -> float:
    """Value t with `P(|T| > t) = 0.05` for `degrees` degrees of freedom, to 1 in 1000.

    Source: G. W. Hill, "Algorithm 396: Student's t-quantiles", Communications of the ACM 13, 1970.

    Raises:
        ValueError: `degrees` is below 1.
    """
    if degrees < 1:
        message = f"degrees = {degrees}: must be 1 or more"
        raise ValueError(message)
    tail = 0.05
    if degrees == 1:
        return 1.0 / math.tan(tail * math.pi / 2.0)
    if degrees == 2:
        return math.sqrt(2.0 / (tail * (2.0 - tail)) - 2.0)
    n = float(degrees)
    a = 1.0 / (n - 0.5)
    b = 48.0 / a**2
    c = ((20700.0 * a / b - 98.0) * a - 16.0) * a + 96.36
    d = ((94.5 / (b + c) - 3.0) / b + 1.0) * math.sqrt(a * math.pi / 2.0) * n
    y = (d * tail) ** (2.0 / n)
    if y > 0.05 + a:
        x = -1.959963984540054
        y = x * x
        if degrees < 5:
            c += 0.3 * (n - 4.5) * (x + 0.6)
        c = (((0.05 * d * x - 5.0) * x - 7.0) * x - 2.0) * x + b + c
        y = (((((0.4 * y + 6.3) * y + 36.0) * y + 94.5) / c - y - 3.0) / b + 1.0) * x
        y = math.expm1(a * y * y)
    else:
        y = ((1.0 / (((n + 6.0) / (n * y) - 0.089 * d - 0.822) * (n + 2.0) * 3.0) + 0.5 / (n + 4.0)) * y - 1.0) * (
            n + 1.0
        ) / (n + 2.0) + 1.0 / y
    return math.sqrt(n * y)


def mean_and_half(values: Array) -> tuple[float, float]:
    """Mean of the finite values and half of its 95 % confidence interval, NaN for fewer than two.

    Args:
        values: (n,); NaN is ignored.
    """
    known = values[np.isfinite(values)]
    if not len(known):
        return math.nan, math.nan
    if len(known) == 1:
        return float(known[0]), math.nan
    spread = float(known.std(ddof=1)) / math.sqrt(len(known))
    return float(known.mean()), student_quantile(len(known) - 1) * spread
