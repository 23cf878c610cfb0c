"""Float-float arithmetic: a number is the unevaluated sum of two float32. For GPUs, where float64 is slow.
A pair is a vec2 (high, low); high is the float32 nearest to high + low. Error bounds assume that nothing over- or underflows; u = 2^-24.
Exact sums and products: Knuth 1969, "The Art of Computer Programming" 2, section 4.2.2; Dekker 1971, "A Floating-Point Technique for
Extending the Available Precision". Others: Da Graca and Defour 2006, "Implementation of float-float operators on graphics hardware"."""

import warp as wp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return fmaf(a, b, -product);
#else
    return (float)((double)a * (double)b - (double)product);  // rounded only by the conversion to float, as fmaf is
#endif
""")
def product_error(a: float, b: float, product: float) -> float:
    """Return the exact rounding error a b - product, where `product` is a b rounded to float32."""


@wp.func
def exact_sum(a: float, b: float) -> wp.vec2:
    """Return a + b, exactly."""
    total = a + b
    of_b = total - a
    return wp.vec2(total, (a - (total - of_b)) + (b - of_b))


@wp.func
def ordered_sum(a: float, b: float) -> wp.vec2:
    """Return a + b, exactly, for |a| >= |b|."""
    total = a + b
    return wp.vec2(total, b - (total - a))


@wp.func
def exact_product(a: float, b: float) -> wp.vec2:
    """Return a b, exactly."""
    product = a * b
    return wp.vec2(product, product_error(a, b, product))


@wp.func
def difference_of_products(a: float, b: float, c: float, d: float) -> wp.vec2:
    """Return a b - c d, with an error of at most 3.1 u^2 (|a b| + |c d|)."""
    ab = exact_product(a, b)
    cd = exact_product(c, d)
    difference = exact_sum(ab[0], -cd[0])
    return exact_sum(difference[0], difference[1] + (ab[1] - cd[1]))


@wp.func
def pair_sum(x: wp.vec2, y: wp.vec2) -> wp.vec2:
    """Return x + y, with an error of at most 3 u^2 (|x| + |y|)."""
    total = exact_sum(x[0], y[0])
    return exact_sum(total[0], total[1] + (x[1] + y[1]))


@wp.func
def pair_times(x: wp.vec2, y: float) -> wp.vec2:
    """Return x y, with an error of at most 3 u^2 |x y|."""
    product = exact_product(x[0], y)
    return ordered_sum(product[0], product[1] + x[1] * y)


@wp.func
def pair_quotient(x: wp.vec2, y: wp.vec2, inverse: float) -> wp.vec2:
    """Return x / y, with an error of at most 30 u^2 |x / y|; inverse: 1 / y[0]."""
    quotient = x[0] * inverse
    back = exact_product(quotient, y[0])
    rest = ((x[0] - back[0]) - back[1]) + (x[1] - quotient * y[1])
    return ordered_sum(quotient, rest * inverse)


@wp.func
def rounding_is_certain(x: wp.vec2, error: float) -> bool:
    """Test whether all real numbers within `error` of x round to x[0]; False for NaN. `error` must exceed u^2 |x|.
    Ziv 1991, "Fast Evaluation of Elementary Mathematical Functions with Correctly Rounded Last Bit"."""
    return x[0] + (x[1] - error) == x[0] and x[0] + (x[1] + error) == x[0]
