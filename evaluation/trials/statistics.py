"""Confidence intervals: Wilson's for a rate, Newcombe's for a difference of two."""

from dataclasses import dataclass
from math import sqrt

Z_95 = 1.959963984540054  # standard normal quantile of a two-sided 95 % interval


@dataclass(frozen=True, slots=True)
class Rate:
    """Successes out of trials, with the 95 % interval of the underlying rate."""

    successes: int
    n: int
    rate: float  # [1] NaN without trials
    low: float  # [1]
    high: float  # [1]


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference of two rates, with its 95 % interval."""

    difference: float  # [1]
    low: float  # [1]
    high: float  # [1]
    disjoint: bool  # whether the two rates' intervals have no point in common


def wilson(successes: int, n: int, z: float = Z_95) -> Rate:
    """Compute Wilson's score interval of a success rate.

    Args:
        successes: Number of successful trials.
        n: Number of trials; 0 gives an unknown rate and the interval 0 to 1.
        z: Standard normal quantile, 1.96 for 95 %.

    Raises:
        ValueError: Not 0 <= successes <= n.

    Source: E. B. Wilson 1927, Journal of the American Statistical Association 22, 209-212.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"0 <= successes <= n expected, found {successes} of {n}")
    if n == 0:
        return Rate(0, 0, float("nan"), 0.0, 1.0)
    p = successes / n
    scale = 1.0 + z * z / n
    middle = (p + z * z / (2 * n)) / scale
    half = z / scale * sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    # At the ends the bound is exactly 0 or 1; rounding would miss it.
    low = 0.0 if successes == 0 else middle - half
    high = 1.0 if successes == n else middle + half
    return Rate(successes, n, p, low, high)


def difference(a: Rate, b: Rate) -> Difference:
    """Return rate a minus rate b, with the square-and-add interval of both.

    The interval combines the two Wilson intervals.

    Raises:
        ValueError: One of them has no trials.

    Source: R. G. Newcombe 1998, Statistics in Medicine 17, 873-890, method 10.
    """
    if a.n == 0 or b.n == 0:
        raise ValueError(f"two rates with trials expected, found {a.n} and {b.n} trials")
    d = a.rate - b.rate
    low = d - sqrt((a.rate - a.low) ** 2 + (b.high - b.rate) ** 2)
    high = d + sqrt((a.high - a.rate) ** 2 + (b.rate - b.low) ** 2)
    return Difference(d, low, high, disjoint=a.low > b.high or b.low > a.high)
