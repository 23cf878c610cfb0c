"""What repeated renders tell: error split into bias and noise, with intervals; the slope of a sweep; the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A number, and the ends of its confidence interval (CONFIDENCE); NaN where it cannot be told."""

    value: float
    low: float
    high: float

    def as_dict(self) -> dict[str, float]:
        return vars(self)


UNKNOWN = Estimate(math.nan, math.nan, math.nan)


def gram(pictures: Sequence[np.ndarray], truth: np.ndarray) -> np.ndarray:
    """(K, K) float64: the mean over pixels and channels of the product of the errors of pictures i and j.

    All there is to know of bias and noise: the diagonal holds each picture's mean squared error.
    """
    errors = np.stack([picture.astype(np.float64).ravel() - truth.ravel() for picture in pictures])
    return errors @ errors.T / errors.shape[1]


def mse_of(products: np.ndarray, known: float) -> float:
    """Mean squared error. products: `gram`; known: the mean variance of the truth, which is in every product."""
    return float(np.diag(products).mean()) - known


def squared_bias_of(products: np.ndarray, known: float) -> float:
    """The mean over pixels of the squared bias, itself unbiased: noise is in no product of two different pictures."""
    n = len(products)
    return float(products.sum() - np.trace(products)) / (n * (n - 1)) - known


def noise_of(products: np.ndarray) -> float:
    """The mean over pixels of the variance: mse = squared bias + noise."""
    return mse_of(products, 0.0) - squared_bias_of(products, 0.0)


def jackknife(statistic: Callable[[np.ndarray], float], n: int) -> tuple[float, float]:
    """A statistic of the repeats `indices` (of n), and its standard error from leaving out one after the other.

    Source: Efron and Tibshirani 1993, "An Introduction to the Bootstrap", chapter 11. n is small here (some 8), where
    percentiles of a bootstrap are too narrow and a jackknife with Student's t is not.
    """
    everything = np.arange(n)
    parts = np.array([statistic(np.delete(everything, i)) for i in range(n)])
    if not np.isfinite(parts).all():
        return statistic(everything), math.nan
    return statistic(everything), math.sqrt((n - 1.0) * float(parts.var()))


@cache
def student_t(freedom: int) -> float:
    """How many standard errors a two-sided interval of CONFIDENCE reaches."""
    from scipy.stats import t

    return float(t.ppf(0.5 + 0.5 * CONFIDENCE, freedom))


def estimate(statistic: Callable[[np.ndarray], float], n: int, *, logarithmic: bool = False) -> Estimate:
    """A statistic of n repeats with its interval; logarithmic: for what is positive and varies by factors."""

    def logarithm(indices: np.ndarray) -> float:
        value = statistic(indices)
        return math.log(value) if value > 0.0 else math.nan

    value, error = jackknife(logarithm if logarithmic else statistic, n)
    reach = student_t(n - 1) * error
    if logarithmic:
        return Estimate(math.exp(value), math.exp(value - reach), math.exp(value + reach))
    return Estimate(value, value - reach, value + reach)


def mean_estimate(values: Sequence[float]) -> Estimate:
    """The mean of repeated values, with Student's interval."""
    array = np.asarray(values, dtype=np.float64)
    return estimate(lambda indices: float(array[indices].mean()), len(array))


def bias_with_bound(products: np.ndarray, known: float) -> tuple[float, float]:
    """Root mean square bias, NaN where it cannot be told from 0; and what it is likely to be below.

    It cannot be told where its square is within the interval of the repeats, or within the truth's own variance.
    """
    n = len(products)
    squared, spread = jackknife(lambda i: squared_bias_of(products[np.ix_(i, i)], known), n)
    reach = student_t(n - 1) * spread + known
    return math.sqrt(squared) if squared > reach else math.nan, math.sqrt(max(squared, 0.0) + reach)


def slope(spp: Sequence[int], errors: Callable[[np.ndarray], Sequence[float]], repeats: int) -> Estimate:
    """The slope of log error over log spp by least squares; errors: of some repeats, one number a level of spp.

    UNKNOWN for fewer than three levels, and where an error is not positive.
    """
    def fit(indices: np.ndarray) -> float:
        y = np.asarray(errors(indices))
        return float(np.polyfit(np.log(spp), np.log(y), 1)[0]) if (y > 0.0).all() else math.nan

    return estimate(fit, repeats) if len(spp) >= 3 and not math.isnan(fit(np.arange(repeats))) else UNKNOWN


def pareto_front(points: Sequence[tuple[float, float]], tolerance: float = 0.01) -> list[int]:
    """The indices of those points (cost, error) that no other beats in both, by rising cost; NaN is never among them.

    What costs more must have an error lower by more than `tolerance` of it: of settings that differ in nothing but the cost,
    one is on the front (the epsilon-dominance of Laumanns et al. 2002, in the error alone).
    """
    usable = [i for i, point in enumerate(points) if all(math.isfinite(x) for x in point)]
    front: list[int] = []
    for i in sorted(usable, key=lambda i: points[i]):
        if not front or points[i][1] < (1.0 - tolerance) * points[front[-1]][1]:
            front.append(i)
    return front
