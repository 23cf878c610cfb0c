"""Float-float arithmetic against exact fractions: exact operations have no error, other operations keep their error bounds."""

from fractions import Fraction

import numpy as np

from tests.kernel_tools import floats, launch, vec2s, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.structs import kernel
from wrt.kernels.units.float_float import (
    difference_of_products,
    exact_product,
    exact_sum,
    pair_quotient,
    pair_sum,
    pair_times,
    rounding_is_certain,
)

U_SQUARED = 2.0**-48
N = 4000


@kernel
def all_of_them(x: wp.array(dtype=wp.vec2), y: wp.array(dtype=wp.vec2), total: wp.array(dtype=wp.vec2),
                product: wp.array(dtype=wp.vec2), difference: wp.array(dtype=wp.vec2), pairs: wp.array(dtype=wp.vec2),
                times: wp.array(dtype=wp.vec2), quotient: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    a, b = x[i], y[i]
    total[i] = exact_sum(a[0], b[0])
    product[i] = exact_product(a[0], b[0])
    difference[i] = difference_of_products(a[0], b[0], a[1], b[1])
    pairs[i] = pair_sum(a, b)
    times[i] = pair_times(a, b[0])
    quotient[i] = pair_quotient(a, b, 1.0 / b[0])


@kernel
def round_kernel(x: wp.array(dtype=wp.vec2), error: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out[i] = wp.where(rounding_is_certain(x[i], error[i]), 1, 0)


def pairs(rng, n):
    """Float-float numbers of any sign, (n, 2) float32. The low part is up to half an ulp of the high part, and often tiny or 0."""
    high = rng.uniform(1.0, 2.0, n).astype(np.float32) * np.exp2(rng.integers(-12, 12, n)).astype(np.float32)
    high *= rng.choice(np.float32([-1.0, 1.0]), n)
    low = (np.spacing(np.abs(high)) * rng.uniform(-0.5, 0.5, n)).astype(np.float32)
    low *= rng.choice(np.float32([0.0, 2.0**-20, 1.0]), n)
    return np.stack([high + low, low - ((high + low) - high)], axis=1)


def fractions(rows):
    return [sum(map(Fraction, row.tolist())) for row in rows]


def test_sums_are_exact_and_the_rest_is_within_its_bounds():
    rng = np.random.default_rng(0)
    x, y = pairs(rng, N), pairs(rng, N)
    y[: N // 4] = -x[: N // 4]  # Sums that cancel completely or almost completely.
    y[: N // 8, 1] = 0.0
    out = [zeros(N, wp.vec2) for _ in range(6)]
    launch(all_of_them, N, vec2s(x), vec2s(y), *out)
    total, product, difference, summed, times, quotient = (each.numpy() for each in out)
    assert all((each[:, 0] == each[:, 0] + each[:, 1]).all() for each in (total, product, difference, summed, times, quotient))
    heads = [[list(map(Fraction, row)) for row in rows.tolist()] for rows in (x, y)]
    zipped = list(zip(*heads, fractions(x), fractions(y), strict=True))
    assert fractions(total) == [a[0] + b[0] for a, b, _, _ in zipped]
    assert fractions(product) == [a[0] * b[0] for a, b, _, _ in zipped]
    bounded = {
        "difference": (difference, 3.1, lambda a, b, x, y: (a[0] * b[0] - a[1] * b[1], abs(a[0] * b[0]) + abs(a[1] * b[1]))),
        "sum": (summed, 3.0, lambda a, b, x, y: (x + y, abs(x) + abs(y))),
        "times": (times, 3.0, lambda a, b, x, y: (x * b[0], abs(x * b[0]))),
        "quotient": (quotient, 30.0, lambda a, b, x, y: (x / y, abs(x / y)))}
    for name, (given, factor, exact) in bounded.items():
        errors = [abs(got - exact(*each)[0]) / exact(*each)[1] for got, each in zip(fractions(given), zipped, strict=True)]
        assert 0.01 * U_SQUARED < max(errors) <= factor * U_SQUARED, name


def test_rounding_is_certain_if_no_midpoint_is_within_the_error():
    """At the high part 1.5 the step of float32 is 2^-23, so that midpoints are 2^-24 from the high part."""
    low = np.float32([0.0, 2.0**-25, 2.0**-24 - 2.0**-40, -(2.0**-25), 2.0**-24 - 2.0**-40, np.nan, 0.0, 0.0])
    error = np.float32([2.0**-26, 2.0**-26, 2.0**-41, 2.0**-26, 2.0**-39, 2.0**-26, np.inf, np.nan])
    out = zeros(len(low), wp.int32)
    launch(round_kernel, len(low), vec2s(np.stack([np.full(len(low), 1.5), low], axis=1)), floats(error), out)
    assert out.numpy().tolist() == [1, 1, 1, 1, 0, 0, 0, 0]
