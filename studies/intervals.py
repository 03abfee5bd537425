"""95 % intervals of counts and samples, each exact or from a named source."""

from collections.abc import Callable, Sequence
from math import exp, lgamma, log, sqrt

import numpy as np

Z95 = 1.959964
FEWEST_OF_MEDIAN = 6
"""The extremes of five values hold the median with only 1 - 2 / 2^5 = 93.75 %."""


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval of the mean of a Poisson count, with 2.5 % at either end.

    Source: Garwood 1936.
    """

    def mean_where(most: int, share: float) -> float:
        """Mean at which a count is at most `most` with probability `share`."""
        spread = 20.0 + 10.0 * sqrt(most + 1.0)
        low, high = max(0.0, most - spread), most + spread
        # Lower counts have a probability below 1e-20 at all of these means.
        first = max(0, int(most - 2.0 * spread))
        n = np.arange(first, most + 1, dtype=np.float64)
        log_factorials = lgamma(first + 1.0) + np.concatenate([[0.0], np.cumsum(np.log(n[1:]))])
        for _ in range(60):
            middle = 0.5 * (low + high)
            below = float(np.exp(n * log(middle) - middle - log_factorials).sum())
            low, high = (middle, high) if below > share else (low, middle)
        return 0.5 * (low + high)

    return 0.0 if count == 0 else mean_where(count - 1, 0.975), mean_where(count, 0.025)


def wilson_interval(count: float, of: float) -> tuple[float, float]:
    """95 % interval of a share; `of` is at least 1.

    Source: Wilson 1927.
    """
    share, z2 = count / of, Z95**2 / of
    middle = (share + 0.5 * z2) / (1.0 + z2)
    half = Z95 * sqrt(share * (1.0 - share) / of + 0.25 * z2 / of) / (1.0 + z2)
    return max(0.0, middle - half), min(1.0, middle + half)


def median_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Two of the values that bracket the median with at least 95 %; None for fewer than six.

    `P(X_(k) <= m <= X_(n+1-k)) = 1 - 2 P(B(n, 1/2) < k)` for any distribution of the values.

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


def binomial_interval(count: int, of: int, confidence: float = 0.95) -> tuple[float, float]:
    """Exact interval of a share; `of` is at least 1, and each end has half of the remaining probability.

    Source: Clopper and Pearson 1934.
    """

    def at_most(most: int, share: float) -> float:
        """P(B(of, share) <= most)."""
        if share <= 0.0 or share >= 1.0:
            return 1.0 if share <= 0.0 or most >= of else 0.0
        logs = (lgamma(of + 1.0) - lgamma(n + 1.0) - lgamma(of - n + 1.0) for n in range(most + 1))
        return sum(exp(each + n * log(share) + (of - n) * log(1.0 - share)) for n, each in enumerate(logs))

    tail = 0.5 * (1.0 - confidence)
    low = 0.0 if count == 0 else _root_of_falling(lambda share: at_most(count - 1, share), 1.0 - tail, 0.0, 1.0)
    high = 1.0 if count == of else _root_of_falling(lambda share: at_most(count, share), tail, 0.0, 1.0)
    return low, high


def gamma_quantile(share: float, shape: float) -> float:
    """Quantile of a gamma variable of scale 1; `chi2_(2 k) / 2` for a whole shape k.

    Computed by bisection on the regularised incomplete gamma function P(k, x).

    Source: Press et al. 2007, section 6.2: its series below x = k + 1, its continued fraction above.
    """
    high = shape + 20.0 + 20.0 * sqrt(shape + 1.0)
    return _root_of_falling(lambda x: 1.0 - _gamma_cdf(shape, x), 1.0 - share, 0.0, high)


def exceedance_interval(order: float, ratio: float, confidence: float = 0.95) -> tuple[int, int]:
    """Range of counts of a new sample above the `order`-th largest point of this one, for any distribution.

    With `T lambda ~ Gamma(k)` the count of a time T' is negative binomial, `P(n) = C(n + k - 1, n) p^k (1 - p)^n`,
    `p = T / (T + T')`.

    Args:
        order: k, above 0; not whole if points come in groups.
        ratio: T' / T.
        confidence: Confidence of the interval; each end has at most half of the rest.

    Source: Gumbel and von Schelling 1950.
    """
    tail, p = 0.5 * (1.0 - confidence), 1.0 / (1.0 + ratio)
    low, count, below = None, 0, 0.0
    while True:
        probability = (
            lgamma(count + order) - lgamma(count + 1.0) - lgamma(order) + order * log(p) + count * log(1.0 - p)
        )
        below += exp(probability)
        if low is None and below > tail:
            low = count
        if below >= 1.0 - tail:
            return low or 0, count
        count += 1


def _root_of_falling(of: Callable[[float], float], value: float, low: float, high: float) -> float:
    """Argument at which a falling function reaches a value."""
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if of(middle) > value else (low, middle)
    return 0.5 * (low + high)


def _gamma_cdf(shape: float, x: float) -> float:
    """P(k, x)."""
    if x <= 0.0:
        return 0.0
    front = exp(shape * log(x) - x - lgamma(shape))
    if x < shape + 1.0:
        term = total = 1.0 / shape
        place = shape
        while term > total * 1e-16:
            place += 1.0
            term *= x / place
            total += term
        return front * total
    # Lentz's method of continued fractions.
    b = x + 1.0 - shape
    c, d = 1e300, 1.0 / b
    fraction = d
    for n in range(1, 100_000):
        a = -n * (n - shape)
        b += 2.0
        d = 1.0 / (a * d + b or 1e-300)
        c = b + a / c or 1e-300
        fraction *= c * d
        if abs(c * d - 1.0) < 1e-15:
            break
    return 1.0 - front * fraction
