"""Outflow curves: what they say in closed form, and fits to samples of a curve that is known."""

from dataclasses import replace

import numpy as np
import pytest

from nmfd.errors import InputError
from nmfd.model.mfd import Cubic, fit, guess, guess_beyond, trapezoid

# The published curve with a tenth of its jam accumulation: the coefficients span nine orders of
# magnitude.
TRUTH = Cubic(a=4.133e-9, b=-8.282e-6, c=0.0042, jam=1000.0)
# One sample in each of the 24 bins, the last one at the jam.
X = TRUTH.jam * (np.arange(24) + 0.5) / 23.5


def same(curve, expected, rel=1e-3):
    assert (curve.a, curve.b, curve.c, curve.jam) == pytest.approx(
        (expected.a, expected.b, expected.c, expected.jam), rel=rel
    )


def test_a_parabola_in_closed_form():
    """g = c x (1 - x/2n) has its most, c n / 2, at n; three quarters at n / 2; the end at 2 n."""
    curve = Cubic(a=0.0, b=-0.004 / 1000.0, c=0.004, jam=2000.0)
    assert curve.critical == pytest.approx(500.0, abs=0.1)
    assert curve.capacity == pytest.approx(1.0)
    assert curve.reaching(0.75) == pytest.approx(250.0, abs=0.1)
    assert curve.reaching(1.0) == curve.critical
    np.testing.assert_allclose(
        curve.outflow(np.array([0.0, 250.0, 1000.0])), [0.0, 0.75, 0.0], atol=1e-12
    )
    np.testing.assert_allclose(curve.rate(np.array([0.0, 250.0])), [0.004, 0.003])


def test_a_trapezoid_in_closed_form():
    """The least of three lines, constant from where a twentieth of the capacity is left; and what
    is no curve."""
    curve = trapezoid(free=0.004, capacity=6.0, wave=0.001, jam=8000.0)
    n = np.array([0.0, 1000.0, 1500.0, 1900.0, 2000.0, 5000.0, 7700.0])
    np.testing.assert_allclose(
        curve.outflow(n), np.minimum(np.minimum(0.004 * n, 6.0), 8.0 - 0.001 * n), atol=1e-12
    )
    assert curve.outflow(9000.0) == pytest.approx(0.3)
    assert curve.critical == pytest.approx(1500.0, abs=0.4)
    with pytest.raises(
        InputError, match="^PiecewiseLinear: expected as many finite outflows as accumulations"
    ):
        replace(curve, accumulations=(1500.0, 1500.0, 7700.0))


def test_beyond_the_jam_the_outflow_is_constant():
    at_jam = TRUTH.outflow(TRUTH.jam)
    assert at_jam == pytest.approx(TRUTH.a * 1e9 + TRUTH.b * 1e6 + TRUTH.c * 1e3)
    np.testing.assert_allclose(TRUTH.outflow(np.array([1000.0, 1500.0, 9000.0])), at_jam)
    np.testing.assert_allclose(TRUTH.rate(4000.0), at_jam / 4000.0)


def test_what_is_no_curve():
    assert TRUTH.problem() is None
    assert "is not positive at" in Cubic(a=TRUTH.a, b=-9e-6, c=TRUTH.c, jam=TRUTH.jam).problem()


@pytest.mark.parametrize(
    "name, value", [("jam", np.inf), ("jam", 0.0), ("a", np.nan), ("b", -np.inf), ("c", np.inf)]
)
def test_numbers_that_give_no_outflow_are_refused(name, value):
    """A cubic with jam = inf gave NaN in every plant."""
    with pytest.raises(
        InputError,
        match=f"^Mfd: {name}: expected a number.*got {value:g} instead; give a finite one$",
    ):
        replace(TRUTH, **{name: value})


def test_a_fit_to_exact_samples_gives_the_coefficients_back():
    same(fit(X, TRUTH.outflow(X)), TRUTH)


@pytest.mark.parametrize("scale", [0.02, 50.0])
def test_a_city_of_another_size_has_the_same_curve_on_other_axes(scale):
    """x and g both times s: c stays, b falls with s, a with its square."""
    same(
        fit(scale * X, scale * TRUTH.outflow(X)),
        Cubic(a=TRUTH.a / scale**2, b=TRUTH.b / scale, c=TRUTH.c, jam=scale * TRUTH.jam),
    )


def test_what_is_no_sample_does_not_count():
    x = np.concatenate([X, [np.nan, 400.0, np.inf, 0.0, -50.0]])
    g = np.concatenate([TRUTH.outflow(X), [1.0, np.nan, 1.0, 9.0, 9.0]])
    same(fit(x, g), TRUTH)
    for nothing in ([], [np.nan], [0.0]):
        with pytest.raises(ValueError, match="no samples"):
            fit(np.array(nothing), np.array(nothing))


def test_every_bin_counts_alike_and_by_its_median():
    """A thousand samples of an empty city and a wild one among three change nothing."""
    g = TRUTH.outflow(X)
    x = np.concatenate([np.full(1000, X[0]), X, X[[5, 5]], X[[9, 9]]])
    many = np.concatenate(
        [np.full(1000, g[0]), g, g[5] * np.array([1.0, 30.0]), g[9] * np.array([0.0, 1.0])]
    )
    same(fit(x, many), TRUTH)


def test_the_jam_is_where_the_outflow_stops_falling():
    short = Cubic(a=TRUTH.a / 0.6**2, b=TRUTH.b / 0.6, c=TRUTH.c, jam=600.0)
    same(fit(X, short.outflow(X)), short, rel=5e-3)


@pytest.mark.parametrize("seed", range(4))
def test_whatever_the_samples_the_curve_is_safe(seed):
    """The rate falls, stays positive up to the jam and keeps to the most that the integration step
    allows."""
    random = np.random.default_rng(seed)
    x = random.uniform(1.0, 500.0, 200)
    for g in (
        random.uniform(0.0, 2.0, 200),
        1e-5 * x**2,
        0.01 * x,
        np.maximum(1.0 - 0.01 * x, 0.0),
        0.02 * x**0.5,
    ):
        for most in (np.inf, 1.0 / 150.0):
            curve = fit(x, g, max_rate=most)
            rate = curve.rate(np.linspace(0.0, curve.jam, 400))
            assert curve.problem() is None
            assert curve.jam <= x.max()
            assert (np.diff(rate) <= 1e-9 * rate[0]).all()
            assert rate[0] <= most * (1.0 + 1e-6)
            assert curve.outflow(curve.jam) >= 0.009 * g.max()


def test_the_most_that_is_allowed_binds():
    """Samples of 0.01 x with at most half of that: the line 0.005 x is as near as a curve may
    come."""
    curve = fit(X, 0.01 * X, max_rate=0.005)
    np.testing.assert_allclose(curve.outflow(X), 0.005 * X, rtol=1e-3)


def test_the_largest_samples_share_a_bin():
    """Of three in the last one the median counts: the largest of all is no bin of its own."""
    x = np.append(X[:-1], [980.0, 990.0, 1000.0])
    g = TRUTH.outflow(np.append(X[:-1], [990.0, 990.0, 990.0]))
    g[-1] *= 9.0
    curve = fit(x, g)
    np.testing.assert_allclose(curve.outflow(X[:-1]), TRUTH.outflow(X[:-1]), rtol=2e-3)


def test_a_guess_beyond_the_data_goes_on_where_they_end():
    """It has the jam accumulation of the lanes, unless the data go beyond its critical one."""
    free = Cubic(a=0.0, b=0.0, c=0.004, jam=500.0)
    near = guess_beyond(free, 1000.0, 200.0)
    assert near.jam == 1000.0
    assert near.outflow(200.0) == pytest.approx(0.8)
    far = guess_beyond(free, 1000.0, 500.0)
    assert far.critical == pytest.approx(500.0, rel=1e-3)
    assert far.critical > 500.0
    assert guess_beyond(free, 1000.0, 200.0, max_rate=0.003) == guess(0.003, 1000.0)
