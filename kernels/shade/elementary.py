"""Elementary functions with the same bits on every device.

They use only integers and operations that IEEE 754 defines to the last bit: float32 sums, products, quotients and roots. The sin
and pow of compilers and C libraries differ between machines. The error is below 1.7 ulp for all arguments (`python -m
tests.elementary` measures the largest error). An ulp is the distance of neighbouring floats at the exact result. All NaNs have the
same bits.

The methods are those of Muller, "Elementary Functions" (3rd ed., 2016). The argument is reduced (chapter 11). A polynomial gives
the function near 0 (chapter 3). A second float carries the rounding errors along. Each polynomial interpolates its function with a
nearly minimal relative error (tests/elementary.py derives the coefficients). Some constants are stored as a sum of parts. The first
parts have so few bits that their products are exact."""

import warp as wp

from wrt.kernels.structs import noinline

SHIFT = wp.constant(12582912.0)  # 1.5 * 2^23: adding it rounds a float to an integer, ties to even.

# For sin and cos: pi / 2 = QUARTER_1 + ... + QUARTER_4. The first two are multiples of 2^-24, the third has 13 bits. TWO_OVER_PI_BITS
# are the bits of 2 / pi, behind 32 zeros.
REDUCED_BY_PARTS = wp.constant(3000.0)  # Up to this |x|, fewer than 2^11 quarter turns are subtracted, exactly.
TWO_OVER_PI = wp.constant(0.6366197466850281)
QUARTER_1 = wp.constant(1.57080078125)
QUARTER_2 = wp.constant(-4.470348358154297e-06)
QUARTER_3 = wp.constant(1.5894329408183694e-08)
QUARTER_4 = wp.constant(-1.074634630414406e-12)
TWO_OVER_PI_BITS = wp.constant(wp.types.vector(8, wp.uint32)(
    0, 0xA2F9836E, 0x4E441529, 0xFC2757D1, 0xF534DDC0, 0xDB629599, 0x3C439041, 0xFE5163AB))
SIN_1, SIN_2, SIN_3 = wp.constant(-0.16666655242443085), wp.constant(0.008332177065312862), wp.constant(-0.0001951719168573618)
COS_1, COS_2, COS_3 = wp.constant(0.041666656732559204), wp.constant(-0.001388773089274764), wp.constant(2.4477101760567166e-05)
# For acos and atan2: pi / 2 in two parts.
HALF_PI, HALF_PI_REST = wp.constant(1.5707963705062866), wp.constant(-4.371138828673793e-08)
ASIN_1, ASIN_2, ASIN_3 = wp.constant(0.16666747629642487), wp.constant(0.07495515793561935), wp.constant(0.045443885028362274)
ASIN_4, ASIN_5 = wp.constant(0.02430625818669796), wp.constant(0.04195747897028923)
ATAN_1, ATAN_2, ATAN_3 = wp.constant(-0.3333323001861572), wp.constant(0.1999407857656479), wp.constant(-0.1417323350906372)
ATAN_4, ATAN_5 = wp.constant(0.10151606798171997), wp.constant(-0.051188621670007706)
# For exp and power: log(2) as one float, and in two parts, the first of 16 bits. LOG_0 and LOG_1 with their rests are 2 / log(2) and
# a third of it; these first parts have 12 bits.
LOG2_E, LOG_2 = wp.constant(1.4426950216293335), wp.constant(0.6931471824645996)
LOG_2_FIRST, LOG_2_REST = wp.constant(0.693145751953125), wp.constant(1.428606765330187e-06)
EXP_1, EXP_2, EXP_3 = wp.constant(0.5), wp.constant(0.16666577756404877), wp.constant(0.041666556149721146)
EXP_4, EXP_5 = wp.constant(0.008363173343241215), wp.constant(0.0013926175888627768)
LOG_0, LOG_0_REST = wp.constant(2.8857421875), wp.constant(-0.0003521057078614831)
LOG_1, LOG_1_REST = wp.constant(0.9619140625), wp.constant(-0.00011736857413779944)
LOG_2ND, LOG_3RD, LOG_4TH = wp.constant(0.5770792961120605), wp.constant(0.4119340479373932), wp.constant(0.33594173192977905)
ROOT_HALF_BITS = wp.constant(0x3F3504F3)  # The bits of the largest float below sqrt(1/2).


@wp.func
def nan() -> float:
    """Return the NaN with the bits 0x7FC00000. Compilers and devices make NaNs with different bits."""
    return wp.cast(0x7FC00000, wp.float32)


@wp.func
def nearest(x: float) -> float:
    """Round x to an integer, for |x| < 2^22."""
    return (x + SHIFT) - SHIFT


@wp.func
def upper(x: float) -> float:
    """Clear the lower 12 of the 24 significant bits of x. The product of two such numbers is exact."""
    return wp.cast(wp.cast(x, wp.uint32) & wp.static(wp.uint32(0xFFFFF000)), wp.float32)


@wp.func
def power_of_two(n: int) -> float:
    """Return 2^n, for -127 < n < 128."""
    return wp.cast((n + 127) << 23, wp.float32)


@wp.func
def reduced(x: float) -> wp.vec3:
    """Return (r, less, n) with |x| = r - less + k pi / 2 and n = k modulo 4, for 2^10 < |x| < inf.

    `less` is the rounding error of r. This is the method of Payne and Hanek (1983). With |x| = m 2^e, only some bits of 2 / pi matter:
    the bits whose product with x is neither a multiple of 4 nor below 2^-62."""
    bits = wp.cast(wp.abs(x), wp.int32)
    m = wp.uint64((bits & 0x7FFFFF) | 0x800000)
    start = (bits >> 23) - 120  # e + 30: index of the first bit that matters
    i = start >> 5
    shift = wp.uint64(start & 31)
    a = (wp.uint64(TWO_OVER_PI_BITS[i]) << wp.uint64(32)) | wp.uint64(TWO_OVER_PI_BITS[i + 1])
    b = wp.uint64(TWO_OVER_PI_BITS[i + 2]) << shift
    c = wp.uint64(TWO_OVER_PI_BITS[i + 3]) << shift
    high = (a << shift) | (b >> wp.uint64(32))
    low = (b & wp.uint64(0xFFFFFFFF)) | (c >> wp.uint64(32))
    turns = m * high + ((m * low) >> wp.uint64(32))  # in units of 2^-62
    quarter = (turns + (wp.uint64(1) << wp.uint64(61))) >> wp.uint64(62)
    beyond = wp.int64(turns << wp.uint64(2))  # in units of 2^-64 quarters
    f = float(beyond)
    f1 = upper(f)
    f2 = (f - f1) + float(beyond - wp.int64(f))
    first = f1 * QUARTER_1
    rest = f2 * QUARTER_1 + f * (QUARTER_2 + QUARTER_3)
    r = first + rest
    return wp.vec3(wp.static(2.0**-64) * r, wp.static(2.0**-64) * ((r - first) - rest), float(int(quarter)))


@wp.func
def sin_cos_of_parts(x: float, r: float, less: float, n: float) -> tuple[float, float]:
    """Return (sin x, cos x) for x = r - less + n pi / 2."""
    z = r * r
    s = wp.where(x == 0.0, x, r - (less - r * z * (SIN_1 + z * (SIN_2 + z * SIN_3))))  # sin(-0) = -0
    half = 0.5 * z
    c = 1.0 - half
    c = c + (((1.0 - c) - half) + (z * z * (COS_1 + z * (COS_2 + z * COS_3)) + r * less))
    quarter = int(n)
    odd = (quarter & 1) != 0
    sin = wp.where(odd, c, s)
    cos = wp.where(odd, s, c)
    return wp.where((quarter & 2) != 0, -sin, sin), wp.where(((quarter + 1) & 2) != 0, -cos, cos)


@wp.func
def near_sin_cos(x: float) -> tuple[float, float]:
    """Return sin_cos for |x| <= REDUCED_BY_PARTS, branch-free, by Cody and Waite's reduction (1980).

    The rounding error of r and the last part of pi / 2 go into `less`."""
    n = nearest(x * TWO_OVER_PI)
    rest = (x - n * QUARTER_1) - n * QUARTER_2
    part = n * QUARTER_3
    r = rest - part
    sin, cos = sin_cos_of_parts(x, r, (part - (rest - r)) + n * QUARTER_4, n)
    return sin, cos


@wp.func
def sin_cos(x: float) -> tuple[float, float]:
    """Return (sin x, cos x), x in radians; NaN for an infinity."""
    sin = nan()
    cos = nan()
    if wp.abs(x) <= REDUCED_BY_PARTS:
        sin, cos = near_sin_cos(x)
    elif wp.abs(x) < wp.inf:
        sign = wp.sign(x)
        parts = reduced(x)
        sin, cos = sin_cos_of_parts(x, sign * parts[0], sign * parts[1], sign * parts[2])
    return sin, cos


@wp.func
def acos(x: float) -> float:
    """Return the angle in [0, pi] whose cosine is x; NaN for |x| > 1. For |x| > 1/2, acos |x| = 2 asin sqrt((1 - |x|) / 2)."""
    a = wp.abs(x)
    if not a <= 1.0:
        return nan()
    inner = a <= 0.5
    z = wp.where(inner, x * x, 0.5 - 0.5 * a)
    s = wp.where(inner, x, wp.sqrt(z))
    beyond = s * z * (ASIN_1 + z * (ASIN_2 + z * (ASIN_3 + z * (ASIN_4 + z * ASIN_5))))  # asin s = s + beyond
    lower = HALF_PI - (s - (HALF_PI_REST - beyond))
    return wp.where(inner, lower, wp.where(x > 0.0, 2.0 * (s + beyond), 2.0 * lower))


@wp.func
def atan2(y: float, x: float) -> float:
    """Return the angle of the point (x, y) in [-pi, pi]. Zeros and infinities give the results that IEEE 754 defines."""
    low = wp.min(wp.abs(x), wp.abs(y))
    high = wp.max(wp.abs(x), wp.abs(y))
    if not wp.abs(x) + wp.abs(y) >= 0.0:
        return nan()
    # atan(low / high); if 2 low > high, it is pi / 4 + atan((low - high) / (low + high)). Branch-free, so that loops vectorise.
    equal = low == high  # Also for zeros and infinities.
    middle = 2.0 * low > high
    half = wp.where(high > 1.0, 0.5, 1.0)  # A factor against overflow.
    over = wp.where(middle, half * low - half * high, low)
    under = wp.where(middle, half * low + half * high, high)
    t = wp.where(equal, 0.0, over / under)
    base = wp.where(wp.where(equal, high > 0.0, middle), 0.5, 0.0)  # in units of pi / 2
    z = t * t
    beyond = t * z * (ATAN_1 + z * (ATAN_2 + z * (ATAN_3 + z * (ATAN_4 + z * ATAN_5))))  # atan t = t + beyond
    angle = base * HALF_PI + (t + (beyond + base * HALF_PI_REST))
    if wp.abs(y) > wp.abs(x):
        angle = HALF_PI - (angle - HALF_PI_REST)
    if wp.cast(x, wp.int32) < 0:
        angle = 2.0 * HALF_PI - (angle - 2.0 * HALF_PI_REST)
    return wp.copysign(angle, y)


@wp.func
def scaled_exp(r: float, n: float) -> float:
    """Return 2^n e^r for |r| < 0.35 and |n| < 152. Multiply by 2^n in two steps, so that a result below 2^-126 is rounded once."""
    z = r * r
    p = 1.0 + (r + z * ((EXP_1 + r * EXP_2) + z * ((EXP_3 + r * EXP_4) + z * EXP_5)))
    first = int(n) >> 1
    return p * power_of_two(first) * power_of_two(int(n) - first)


@wp.func
def exp(x: float) -> float:
    """Return e^x; 0 below -103.98, inf above 88.73."""
    if not wp.abs(x) < 104.0:
        return wp.where(x >= 104.0, wp.inf, wp.where(x <= -104.0, 0.0, nan()))
    n = nearest(x * LOG2_E)
    return scaled_exp((x - n * LOG_2_FIRST) - n * LOG_2_REST, n)


@wp.func
def power_of_positive(x: float, y: float) -> float:
    """Return x^y = 2^(y log2 x), for 0 < x < inf and any y but NaN.

    Let x = m 2^k with m near 1, and s = (m - 1) / (m + 1). Then log2 m = (2 / log 2) atanh s = s g(s^2). The fraction of y log2 x
    gives the result's digits, and its integer part may take 8 bits of a float. So s, g, the logarithm and y are each split into 12
    bits and a rest. The product of the first parts is exact, and the rests are so small that their rounding does no harm."""
    tiny = x < wp.static(2.0**-126)
    bits = wp.cast(wp.where(tiny, x * wp.static(2.0**24), x), wp.int32) - ROOT_HALF_BITS
    k = float((bits >> 23) - wp.where(tiny, 24, 0))
    m = wp.cast((bits & 0x7FFFFF) + ROOT_HALF_BITS, wp.float32)
    # s = s1 + s2.
    d = m + 1.0
    d1 = upper(d)
    d2 = (d - d1) + (m - (d - 1.0))
    inverse = 1.0 / d
    s = (m - 1.0) * inverse
    s1 = upper(s)
    s2 = (((m - 1.0) - s1 * d1) - s1 * d2) * inverse
    # z = s^2 = z1 + z2, and g = g1 + g2: 2 / log 2 + z (2 / (3 log 2) + z ...).
    square = s1 * s1
    square_rest = s2 * (s + s1)
    z = square + square_rest
    z1 = upper(z)
    z2 = (square - z1) + square_rest
    more = z1 * LOG_1_REST + z2 * (LOG_1 + LOG_1_REST) + z * z * (LOG_2ND + z * (LOG_3RD + z * LOG_4TH))
    g = LOG_0 + (z1 * LOG_1 + (more + LOG_0_REST))
    g1 = upper(g)
    g2 = ((LOG_0 - g1) + z1 * LOG_1) + (more + LOG_0_REST)
    # log2 x = whole + rest = l1 + l2.
    first = s1 * g1
    whole = k + first
    rest = ((k - whole) + first) + (s1 * g2 + s2 * g)
    l1 = upper(whole + rest)
    l2 = (whole - l1) + rest
    # y log2 x = e1 + e2. As |log2 x| is at least 2^-24, any |y| above 2^32 overflows or underflows like 2^32.
    limited = wp.clamp(y, -wp.static(2.0**32), wp.static(2.0**32))
    y1 = upper(limited)
    e1 = y1 * l1
    e2 = y1 * l2 + (limited - y1) * (l1 + l2)
    if wp.abs(e1) > 151.0:
        return wp.where(e1 > 0.0, wp.inf, 0.0)
    n = nearest(e1 + e2)
    return scaled_exp(((e1 - n) + e2) * LOG_2, n)


@noinline  # Inlined, it would add 10 % to the compile time of a shading kernel.
def power(x: float, y: float) -> float:
    """Return x^y with the special cases of IEEE 754's `pow`: NaN if x < 0 and y is not an integer."""
    if y == 0.0 or x == 1.0:
        return 1.0
    a = wp.abs(x)
    if not a + wp.abs(y) >= 0.0:
        return nan()
    sign = float(1.0)
    if wp.cast(x, wp.int32) < 0:
        whole = wp.floor(y) == y
        if whole and wp.abs(y) < wp.static(2.0**24):  # All larger floats are even.
            if (int(y) & 1) != 0:
                sign = -1.0
        if not whole and a > 0.0 and a < wp.inf:
            return nan()
    if a == 1.0:
        return sign
    if a == 0.0 or a == wp.inf:
        return sign * wp.where((a == 0.0) == (y < 0.0), wp.inf, 0.0)
    return sign * power_of_positive(a, y)
