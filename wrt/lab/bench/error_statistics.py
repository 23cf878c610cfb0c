"""Statistics of renders with several seeds: bias and noise with confidence intervals, and slopes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """A value and the ends of its confidence interval (of probability CONFIDENCE); NaN if unknown."""

    value: float
    low: float
    high: float


UNKNOWN = Estimate(math.nan, math.nan, math.nan)


def gram(pictures: Sequence[np.ndarray], truth: np.ndarray) -> np.ndarray:
    """Return (K, K) float64: element (i, j) is the mean over pixels and channels of picture i's error times picture j's error."""
    errors = np.stack([picture.astype(np.float64).ravel() - truth.ravel() for picture in pictures])
    return errors @ errors.T / errors.shape[1]


def mse_of(products: np.ndarray, known: float) -> float:
    """Return the mean squared error of a picture. products: result of `gram`; known: variance of the truth, contained in each product."""
    return float(np.diag(products).mean()) - known


def squared_bias_of(products: np.ndarray, known: float) -> float:
    """Return an unbiased estimate of the mean squared bias, from the products of different pictures: their noise averages to 0."""
    n = len(products)
    return float(products.sum() - np.trace(products)) / (n * (n - 1)) - known


def noise_of(products: np.ndarray) -> float:
    """Return the variance of a picture, averaged over pixels and channels: mean squared error less squared bias."""
    return mse_of(products, 0.0) - squared_bias_of(products, 0.0)


def jackknife(statistic: Callable[[np.ndarray], float], n: int) -> tuple[float, float]:
    """Return a statistic of n repeats and its standard error by leaving out one repeat at a time. The error is NaN if unknown.
    Source: Efron and Tibshirani 1993, "An Introduction to the Bootstrap", chapter 11. For n of about 8, a bootstrap's percentile intervals
    are too narrow; a jackknife with Student's t is not. statistic: indices of the repeats to use -> value."""
    everything = np.arange(n)
    parts = np.array([statistic(np.delete(everything, i)) for i in range(n)])
    return statistic(everything), math.sqrt((n - 1.0) * float(parts.var())) if np.isfinite(parts).all() else math.nan


def student_t(freedom: int) -> float:
    """Return half the width of a two-sided CONFIDENCE interval, in standard errors. freedom: degrees of freedom."""
    from scipy.stats import t

    return float(t.ppf(0.5 + 0.5 * CONFIDENCE, freedom))


def estimate(statistic: Callable[[np.ndarray], float], n: int, *, logarithmic: bool = False) -> Estimate:
    """Return a statistic of n repeats with its confidence interval. logarithmic: compute it on the logarithm, for positive values."""

    def logarithm(indices: np.ndarray) -> float:
        value = statistic(indices)
        return math.log(value) if value > 0.0 else math.nan

    value, error = jackknife(logarithm if logarithmic else statistic, n)
    reach = student_t(n - 1) * error
    if logarithmic:
        return Estimate(math.exp(value), math.exp(value - reach), math.exp(value + reach))
    return Estimate(value, value - reach, value + reach)


def mean_estimate(values: Sequence[float]) -> Estimate:
    """Return the mean of repeated values with its confidence interval."""
    array = np.asarray(values, dtype=np.float64)
    return estimate(lambda indices: float(array[indices].mean()), len(array))


def bias_with_bound(products: np.ndarray, known: float) -> tuple[float, float]:
    """Return the root mean square bias and its upper bound. The bias is NaN if noise or the truth's variance could explain it."""
    n = len(products)
    squared, spread = jackknife(lambda i: squared_bias_of(products[np.ix_(i, i)], known), n)
    reach = student_t(n - 1) * spread + known
    return math.sqrt(squared) if squared > reach else math.nan, math.sqrt(max(squared, 0.0) + reach)


def slope(spp: Sequence[int], errors: Callable[[np.ndarray], Sequence[float]], repeats: int) -> Estimate:
    """Fit a line to log error over log spp by least squares; return its slope. errors: indices of repeats -> an error for each spp.
    Return UNKNOWN for fewer than three values of spp, or if an error is not positive."""
    def fit(indices: np.ndarray) -> float:
        y = np.asarray(errors(indices))
        return float(np.polyfit(np.log(spp), np.log(y), 1)[0]) if (y > 0.0).all() else math.nan

    return estimate(fit, repeats) if len(spp) >= 3 and not math.isnan(fit(np.arange(repeats))) else UNKNOWN
