"""The elementary functions against the C library in float64; the largest errors against 60 decimal digits."""

from decimal import Decimal, getcontext, localcontext
from fractions import Fraction

import numpy as np
import pytest

from tests import elementary
from tests.elementary import ONE, TWO

from tests.kernel_tools import floats, launch, zeros  # isort: skip (starts Warp)
import warp as wp

from wrt.kernels.shade import elementary as functions
from wrt.kernels.shade.elementary import acos, atan2, exp, power, sin_cos
from wrt.kernels.structs import kernel

FUNCTIONS = ("sin", "cos", "acos", "exp", "atan2", "power")
BOUND = {"sin": 1.0, "cos": 1.0, "acos": 1.3, "exp": 1.1, "atan2": 1.7, "power": 1.3}  # ulp
PRIME = 4099  # A stride through all bit patterns of float32.
QUIET_NAN = 0x7FC00000


@kernel
def call_functions(x: wp.array(dtype=float), y: wp.array(dtype=float), out: wp.array2d(dtype=float)):
    """Store in out[i] the values of all FUNCTIONS, in their order, of x[i] or of (x[i], y[i])."""
    i = wp.tid()
    sin, cos = sin_cos(x[i])
    out[i, 0] = sin
    out[i, 1] = cos
    out[i, 2] = acos(x[i])
    out[i, 3] = exp(x[i])
    out[i, 4] = atan2(x[i], y[i])
    out[i, 5] = power(x[i], y[i])


def called(x: object, y: object = 1.0) -> dict[str, np.ndarray]:
    """Return the results of every function for x and y, by name."""
    x, y = np.broadcast_arrays(np.asarray(x, np.float32), np.asarray(y, np.float32))
    out = wp.zeros((x.size, len(FUNCTIONS)), dtype=wp.float32, device=elementary.DEVICE)
    launch(call_functions, x.size, floats(x.ravel()), floats(y.ravel()), out)
    return dict(zip(FUNCTIONS, out.numpy().T, strict=True))


# --- 60 digits -------------------------------------------------------------------------------------------------------


def arctangent(x: Decimal) -> Decimal:
    """Compute the arctangent by halving the angle until its series is short."""
    halvings = 0
    while abs(x) > Decimal("0.01"):
        x, halvings = x / (1 + (1 + x * x).sqrt()), halvings + 1
    return 2**halvings * sum(((-1) ** i * x ** (2 * i + 1) / (2 * i + 1) for i in range(30)), Decimal(0))


def sine(x: Decimal) -> Decimal:
    """Compute the sine for |x| <= 4."""
    term, total, i = x, x, 1
    while abs(term) > Decimal("1e-80"):
        term = -term * x * x / ((i + 1) * (i + 2))
        total, i = total + term, i + 2
    return total


def exactly(name: str, x: float, y: float = 0.0) -> Decimal:
    getcontext().prec = 120  # The largest float has 39 digits before the point.
    a, b = Decimal(x), Decimal(y)
    pi = 4 * arctangent(Decimal(1))
    if name in ("sin", "cos"):
        angle = a + pi / 2 if name == "cos" else a
        turns = (angle / (2 * pi)).to_integral_value()
        return sine(angle - turns * 2 * pi)
    if name == "acos":
        return 2 * arctangent(((1 - a) / (1 + a)).sqrt())
    if name == "atan2":
        flat = arctangent(a / b)
        return flat if b > 0 else flat + pi.copy_sign(a)
    return a.exp() if name == "exp" else (b * a.ln()).exp()


def error_in_ulp(found: float, exact: Decimal) -> float:
    place = Fraction(2) ** (max(int(np.frexp(float(exact))[1]) - 1, -126) - 23)
    return float(abs(Fraction(found) - Fraction(exact)) / place)


# --- all floats -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ONE)
def test_every_4099th_float_of_one_argument(name: str) -> None:
    worst, x = elementary.worst_of_one(name, PRIME, first=PRIME // 2)
    assert 0.5 < worst < BOUND[name]
    with localcontext():
        assert error_in_ulp(float(called(x)[name][0]), exactly(name, x)) == pytest.approx(worst, abs=1e-5)


def test_zeros_keep_their_sign() -> None:
    found = called([0.0, -0.0])
    assert np.signbit(found["sin"]).tolist() == [False, True] and found["cos"].tolist() == found["exp"].tolist() == [1.0, 1.0]


@pytest.mark.slow  # Takes minutes.
@pytest.mark.parametrize("name", ONE)
def test_all_floats_of_one_argument(name: str) -> None:
    assert elementary.worst_of_one(name)[0] < BOUND[name]


@pytest.mark.parametrize("name", TWO)
def test_pairs(name: str) -> None:
    worst, x, y = elementary.worst_of_two(name, *elementary.random_pairs(name, 1 << 20, seed=1))
    assert 0.5 < worst < BOUND[name]
    if name == "atan2" or x > 0.0:
        with localcontext():
            assert error_in_ulp(float(called(x, y)[name][0]), exactly(name, x, y)) == pytest.approx(worst, abs=1e-5)
    assert elementary.worst_of_two(name, *elementary.special_pairs())[0] < BOUND[name]


def test_a_wrong_result_is_an_error() -> None:
    """The error measure detects an error of one ulp, a wrong sign of zero, an early infinity, and a number in place of NaN."""

    @elementary.kernel
    def measured(found: wp.array(dtype=float), exact: wp.array(dtype=wp.float64), out: wp.array(dtype=float)):
        out[wp.tid()] = elementary.ulps(found[wp.tid()], exact[wp.tid()])

    rows = [(1.0 + 2.0**-23, 1.0, 1.0), (-0.0, 0.0, np.inf), (np.inf, 2.0**128 - 2.0**105, 2.0), (1.0, np.nan, np.inf),
            (np.nan, 1.0, np.inf), (2.0**-149, 0.0, 1.0), (np.inf, 1e39, 0.0), (np.nan, np.nan, 0.0), (0.0, 2.0**-150, 0.5)]
    found, exact, expected = (list(column) for column in zip(*rows, strict=True))
    out = zeros(len(rows))
    launch(measured, len(rows), floats(found), wp.array(exact, dtype=wp.float64, device=elementary.DEVICE), out)
    assert out.numpy().tolist() == expected


def test_a_nan_has_always_the_same_bits() -> None:
    nan, other = np.nan, np.uint32(0xFFC12345).view(np.float32)
    x, y = [np.inf, -np.inf, nan, other, 2.0, -1.5, -1.0], [nan, nan, 1.0, other, nan, 0.5, nan]
    bits = {name: each.view(np.uint32) for name, each in called(x, y).items()}
    assert (bits["sin"][:4] == QUIET_NAN).all() and (bits["cos"][:4] == QUIET_NAN).all()
    assert (bits["acos"][:6] == QUIET_NAN).all() and (bits["exp"][2:4] == QUIET_NAN).all()
    assert (bits["atan2"][[0, 1, 2, 3, 4, 6]] == QUIET_NAN).all() and (bits["power"] == QUIET_NAN).all()


# --- constants -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("series", "names"), [
    ("sin", ("SIN_1", "SIN_2", "SIN_3")), ("cos", ("COS_1", "COS_2", "COS_3")), ("log", ("LOG_2ND", "LOG_3RD", "LOG_4TH")),
    ("asin", [f"ASIN_{i}" for i in range(1, 6)]), ("atan", [f"ATAN_{i}" for i in range(1, 6)]),
    ("exp", [f"EXP_{i}" for i in range(1, 6)])])
def test_coefficients_are_those_derived(series: str, names: list[str]) -> None:
    derived = elementary.derived(series, len(names)).astype(np.float32)
    assert [getattr(functions, name) for name in names] == derived.tolist()


def test_constants_in_parts_are_their_sum() -> None:
    with localcontext():
        getcontext().prec = 120
        half_pi, log_2 = 2 * arctangent(Decimal(1)), Decimal(2).ln()
        quarters = [functions.QUARTER_1, functions.QUARTER_2, functions.QUARTER_3, functions.QUARTER_4]
        words = sum(int(word) << (32 * (7 - i)) for i, word in enumerate(functions.TWO_OVER_PI_BITS))
        for parts, whole, error in [
            (quarters, half_pi, 2.0**-64), ([functions.HALF_PI, functions.HALF_PI_REST], half_pi, 2.0**-49),
            ([functions.LOG_2_FIRST, functions.LOG_2_REST], log_2, 2.0**-43), ([functions.LOG_2], log_2, 2.0**-25),
            ([functions.LOG2_E], 1 / log_2, 2.0**-24), ([functions.TWO_OVER_PI], 1 / half_pi, 2.0**-25),
            ([functions.LOG_0, functions.LOG_0_REST], 2 / log_2, 2.0**-36),
            ([functions.LOG_1, functions.LOG_1_REST], 2 / (3 * log_2), 2.0**-37)]:
            assert abs(sum(Decimal(part) for part in parts) - whole) < Decimal(error)
            assert all(float(np.float32(part)) == part for part in parts)
        assert words == int(Decimal(2) ** 224 / half_pi)
