"""Logistic fit of success over difficulty: where success falls to half, with its interval."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array

_BEYOND = 0.5  # [1] of the range of difficulties, by which the place of half success may lie outside of it
_PLACES, _WIDTHS = 401, 81  # of the grid
_LEAST_WIDTH, _MOST_WIDTH = 0.005, 0.5  # [1] of the range: scale of the logistic function
_TAILS = (0.025, 0.5, 0.975)


@dataclass(frozen=True, slots=True)
class LogisticFit:
    """Success rate that falls along a logistic function of the difficulty."""

    half: tuple[float, float, float]  # where success falls to half: median, and 95 % interval
    low: Array  # (n,) [1] lower end of the 95 % interval of the success rate at the queried difficulties
    rate: Array  # (n,) [1] median of the success rate
    high: Array  # (n,) [1] upper end


def fit_success(x: Array, successes: NDArray[np.int_], trials: NDArray[np.int_], at: Array) -> LogisticFit:
    """Fit a falling logistic function to success rates.

    The posterior is computed on a grid of the place of half success and of the logarithm of the scale, with uniform priors. It
    exists also where all trials below some difficulty succeed and all above fail, for which maximum likelihood has no answer.

    Args:
        x: (m,) difficulties from easy to impossible, rising or falling.
        successes: (m,) successes at each.
        trials: (m,) trials at each.
        at: (n,) difficulties at which the success rate is returned.

    Source: B. Treutwein and H. Strasburger 1999, Perception & Psychophysics 61, 87-106, without lapses.
    """
    easy, span = x[0], x[-1] - x[0]
    place = np.linspace(-_BEYOND, 1.0 + _BEYOND, _PLACES)[:, None]
    width = np.geomspace(_LEAST_WIDTH, _MOST_WIDTH, _WIDTHS)[None, :]

    def exponent(value: float) -> Array:
        return np.asarray(((value - easy) / span - place) / width)

    log_posterior = np.zeros((_PLACES, _WIDTHS))
    for value, good, count in zip(x.tolist(), successes.tolist(), trials.tolist(), strict=True):
        e = exponent(value)
        log_posterior -= good * np.logaddexp(0.0, e) + (count - good) * np.logaddexp(0.0, -e)
    weights = np.exp(log_posterior - log_posterior.max())
    low, middle, high = _quantiles(np.broadcast_to(place, weights.shape), weights)
    ends = sorted((easy + low * span, easy + high * span))
    rates = [_quantiles(1.0 / (1.0 + np.exp(np.clip(exponent(value), -500.0, 500.0))), weights) for value in at.tolist()]
    of_rate = np.array(rates).reshape(-1, 3).T
    return LogisticFit((float(easy + middle * span), float(ends[0]), float(ends[1])), *of_rate)


def _quantiles(values: Array, weights: Array) -> list[float]:
    """Return the weighted quantiles `_TAILS` of values."""
    order = np.argsort(values, axis=None)
    total = np.cumsum(weights.ravel()[order])
    return [float(values.ravel()[order[np.searchsorted(total, tail * total[-1])]]) for tail in _TAILS]
