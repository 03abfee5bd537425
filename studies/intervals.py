"""95 % intervals of what was counted or drawn, each exact or of a named source."""

from collections.abc import Sequence
from math import comb, exp, lgamma, log, sqrt

Z95 = 1.959964


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval of the mean of a Poisson count: at either end 2.5 % lie beyond the count.

    Source: Garwood 1936.
    """

    def mean_where(most: int, share: float) -> float:
        """The mean at which so large a share of counts is at most `most`."""
        low, high = 0.0, most + 20.0 + 10.0 * sqrt(most + 1.0)
        for _ in range(60):
            middle = 0.5 * (low + high)
            below = sum(exp(n * log(middle) - middle - lgamma(n + 1.0)) for n in range(most + 1))
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


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """Two of the values between which the median lies with at least 95 %, or the outermost of fewer than six.

    `P(X_(k) <= m <= X_(n+1-k)) = 1 - 2 P(B(n, 1/2) < k)`, whatever the law of the values.

    Source: David and Nagaraja 2003, section 7.1.
    """
    ordered, count = sorted(values), len(values)
    rank, below = 1, 0.5**count
    while below + comb(count, rank) * 0.5**count <= 0.025:
        below += comb(count, rank) * 0.5**count
        rank += 1
    return ordered[rank - 1], ordered[count - rank]
