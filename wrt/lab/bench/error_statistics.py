"""Statistics of repeated renders: bias and noise with confidence intervals, slopes, and the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A value and the ends of its confidence interval (CONFIDENCE); NaN if unknown."""

    value: float
    low: float
    high: float


UNKNOWN = Estimate(math.nan, math.nan, math.nan)


def gram(pictures: Sequence[np.ndarray], truth: np.ndarray) -> np.ndarray:
    """Return (K, K) float64: the mean over pixels and channels of the product of the errors of pictures i and j."""
    errors = np.stack([picture.astype(np.float64).ravel() - truth.ravel() for picture in pictures])
    return errors @ errors.T / errors.shape[1]


def mse_of(products: np.ndarray, known: float) -> float:
    """Return the mean squared error. products: `gram`; known: the mean variance of the truth, which is in every product."""
    return float(np.diag(products).mean()) - known


def squared_bias_of(products: np.ndarray, known: float) -> float:
    """Return an unbiased estimate of the mean squared bias: noise is in no product of two different pictures."""
    n = len(products)
    return float(products.sum() - np.trace(products)) / (n * (n - 1)) - known


def noise_of(products: np.ndarray) -> float:
    """Return the mean over pixels of the variance: mse = squared bias + noise."""
    return mse_of(products, 0.0) - squared_bias_of(products, 0.0)


def jackknife(statistic: Callable[[np.ndarray], float], n: int) -> tuple[float, float]:
    """Return a statistic of n repeats, and its standard error from leaving out one repeat at a time.
    Source: Efron and Tibshirani 1993, "An Introduction to the Bootstrap", chapter 11. For n of about 8, percentiles of a bootstrap are too
    narrow; a jackknife with Student's t is not."""
    everything = np.arange(n)
    parts = np.array([statistic(np.delete(everything, i)) for i in range(n)])
    if not np.isfinite(parts).all():
        return statistic(everything), math.nan
    return statistic(everything), math.sqrt((n - 1.0) * float(parts.var()))


def student_t(freedom: int) -> float:
    """Return the half width of a two-sided interval of CONFIDENCE, in standard errors."""
    from scipy.stats import t

    return float(t.ppf(0.5 + 0.5 * CONFIDENCE, freedom))


def estimate(statistic: Callable[[np.ndarray], float], n: int, *, logarithmic: bool = False) -> Estimate:
    """Return a statistic of n repeats with its interval. logarithmic: for positive values that vary by factors."""

    def logarithm(indices: np.ndarray) -> float:
        value = statistic(indices)
        return math.log(value) if value > 0.0 else math.nan

    value, error = jackknife(logarithm if logarithmic else statistic, n)
    reach = student_t(n - 1) * error
    if logarithmic:
        return Estimate(math.exp(value), math.exp(value - reach), math.exp(value + reach))
    return Estimate(value, value - reach, value + reach)


def mean_estimate(values: Sequence[float]) -> Estimate:
    """Return the mean of repeated values with Student's interval."""
    array = np.asarray(values, dtype=np.float64)
    return estimate(lambda indices: float(array[indices].mean()), len(array))


def bias_with_bound(products: np.ndarray, known: float) -> tuple[float, float]:
    """Return the root mean square bias, NaN if its square is within its own interval plus the truth's variance; and a bound on it."""
    n = len(products)
    squared, spread = jackknife(lambda i: squared_bias_of(products[np.ix_(i, i)], known), n)
    reach = student_t(n - 1) * spread + known
    return math.sqrt(squared) if squared > reach else math.nan, math.sqrt(max(squared, 0.0) + reach)


def slope(spp: Sequence[int], errors: Callable[[np.ndarray], Sequence[float]], repeats: int) -> Estimate:
    """Fit log error over log spp by least squares. errors: of chosen repeats, a value for each spp.
    Return UNKNOWN for fewer than three values of spp, or if an error is not positive."""
    def fit(indices: np.ndarray) -> float:
        y = np.asarray(errors(indices))
        return float(np.polyfit(np.log(spp), np.log(y), 1)[0]) if (y > 0.0).all() else math.nan

    return estimate(fit, repeats) if len(spp) >= 3 and not math.isnan(fit(np.arange(repeats))) else UNKNOWN


def pareto_front(points: Sequence[tuple[float, float]], tolerance: float = 0.01) -> list[int]:
    """Return the indices of the points (cost, error) that no other point beats in both, by rising cost, without NaN.
    A higher cost must lower the error by more than the share `tolerance`, so settings with equal error give one point of the front. Source:
    epsilon-dominance of Laumanns et al. 2002, in the error alone."""
    usable = [i for i, point in enumerate(points) if all(math.isfinite(x) for x in point)]
    front: list[int] = []
    for i in sorted(usable, key=lambda i: points[i]):
        if not front or points[i][1] < (1.0 - tolerance) * points[front[-1]][1]:
            front.append(i)
    return front
