"""95 % intervals of what was counted or drawn, each exact or of a named source."""

from collections.abc import Sequence
from math import lgamma, log, sqrt

import numpy as np

Z95 = 1.959964
FEWEST_OF_MEDIAN = 6
"""Of five values the outermost hold the median with 1 - 2 / 2^5 = 93.75 % only."""


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval of the mean of a Poisson count: at either end 2.5 % lie beyond the count.

    Source: Garwood 1936.
    """

    def mean_where(most: int, share: float) -> float:
        """The mean at which so large a share of counts is at most `most`."""
        spread = 20.0 + 10.0 * sqrt(most + 1.0)
        low, high = max(0.0, most - spread), most + spread
        # Counts further below have a share of less than 1e-20 at all of these means.
        first = max(0, int(most - 2.0 * spread))
        n = np.arange(first, most + 1, dtype=np.float64)
        log_factorials = lgamma(first + 1.0) + np.concatenate([[0.0], np.cumsum(np.log(n[1:]))])
        for _ in range(60):
            middle = 0.5 * (low + high)
            below = float(np.exp(n * log(middle) - middle - log_factorials).sum())
            low, high = (middle, high) if below > share else (low, middle)
        return 0.5 * (low + high)

    return 0.0 if count == 0 else mean_where(count - 1, 0.975), mean_where(count, 0.025)


def wilson_interval(count: int, of: int) -> tuple[float, float]:
    """95 % interval of a share of at least one.

    Source: Wilson 1927.
    """
    share, z2 = count / of, Z95**2 / of
    middle = (share + 0.5 * z2) / (1.0 + z2)
    half = Z95 * sqrt(share * (1.0 - share) / of + 0.25 * z2 / of) / (1.0 + z2)
    return max(0.0, middle - half), min(1.0, middle + half)


def median_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Two of the values between which the median lies with at least 95 %; none of fewer than six.

    `P(X_(k) <= m <= X_(n+1-k)) = 1 - 2 P(B(n, 1/2) < k)`, whatever the law of the values.

    Source: David and Nagaraja 2003, section 7.1.
    """
    ordered, count = sorted(values), len(values)
    if count < FEWEST_OF_MEDIAN:
        return None
    k = np.arange(count // 2 + 1, dtype=np.float64)
    log_ratios = np.concatenate([[0.0], np.cumsum(np.log((count - k[1:] + 1.0) / k[1:]))])
    below = np.cumsum(np.exp(log_ratios - count * log(2.0)))
    rank = int((below <= 0.025).sum())
    return ordered[rank - 1], ordered[count - rank]
