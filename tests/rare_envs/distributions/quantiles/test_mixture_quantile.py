"""Quantiles in plain numbers, against distribution functions in 50 digits."""

import mpmath
import numpy as np
import pytest
from scipy import special

from rare_envs.distributions.quantiles import mixture_quantile
from rare_envs.distributions.quantiles.mixture_quantile import MixtureColumn, search_quantiles, sum_components
from tests.rare_envs.distributions.quantiles.random_columns import draw_columns

mpmath.mp.dps = 50


def exact_tail(column: MixtureColumn, i: int, x: float, upper: bool):
    """Probability beyond x on one side of row i, in 50 digits."""
    number = mpmath.mpf
    log_weights, mean, scale = (np.broadcast_to(a, (len(column.mean), len(column.low))) for a in column[:3])
    share = np.broadcast_to(column.share, (len(column.share), len(column.low)))
    total = number(0)
    for part, (first, end) in enumerate(zip(column.edges[:-1], column.edges[1:], strict=True)):
        inside, beyond = number(0), number(0)
        for k in range(first, end):
            ends = [number(float(each)) for each in (column.low[i], x, column.high[i])]
            y = [mpmath.log(each) for each in ends] if k >= column.n_plain else ends
            z = [(each - number(float(mean[k, i]))) / number(float(scale[k, i])) for each in y]
            below = [mpmath.ncdf(-each if upper else each) for each in z]
            weight = mpmath.exp(number(float(log_weights[k, i])))
            inside += weight * abs(below[2] - below[0])
            beyond += weight * abs(below[1] - below[2 if upper else 0])
        total += number(float(share[part, i])) * beyond / inside
    return total


@pytest.mark.parametrize("n_plain", [3, 2, 0])
def test_the_probability_beyond_a_quantile_is_that_of_a_normal_in_both_tails(n_plain: int) -> None:
    """To two floats of x and 1e-12 of the smaller tail: out to 12 standard deviations, cut intervals among them."""
    rng = np.random.default_rng(n_plain)
    column, n = draw_columns(rng, n_plain=n_plain, n_log=3 - n_plain, n=150), 150
    u = np.concatenate([rng.standard_normal(50) * 2.0, rng.uniform(-12.0, 12.0, n - 50)])
    x, fits = search_quantiles(column, u)
    assert fits.all()
    for i in range(n):
        upper, wanted = bool(u[i] > 0), mpmath.ncdf(-abs(mpmath.mpf(float(u[i]))))
        around = np.clip(x[i] + 2.0 * np.spacing(x[i]) * np.array([-1.0, 1.0]), column.low[i], column.high[i])
        least, most = sorted(exact_tail(column, i, each, upper) for each in around)
        assert least * (1 - 1e-12) <= wanted <= most * (1 + 1e-12), (i, u[i], x[i])


def test_a_row_does_not_depend_on_the_others() -> None:
    column, u = draw_columns(np.random.default_rng(3), 2, 2, 200), np.random.default_rng(4).normal(0.0, 4.0, 200)
    x, _ = search_quantiles(column, u)
    for rows in (np.array([7]), np.array([150, 3]), np.arange(0, 200, 3)):
        some = [array[:, rows] if array.shape[1] > 1 else array for array in column[:3]]
        share = column.share[:, rows] if column.share.shape[1] > 1 else column.share
        part = MixtureColumn(*some, column.low[rows], column.high[rows], column.edges, share, column.n_plain)
        assert (search_quantiles(part, u[rows])[0] == x[rows]).all()


def test_quantiles_rise_with_u_and_stay_in_the_interval() -> None:
    one = [np.repeat(array[:, :1], 500, axis=1) for array in draw_columns(np.random.default_rng(5), 2, 1, 1)[:3]]
    ends = np.full(500, 0.4), np.full(500, 30.0)
    column = MixtureColumn(*one, *ends, (0, 2, 3), np.array([[0.7], [0.3]]), 2)
    x, fits = search_quantiles(column, np.linspace(-29.0, 29.0, 500))
    assert fits.all()
    assert ((x >= 0.4) & (x <= 30.0)).all()
    assert (np.diff(x) >= 0).all()
    assert (np.diff(x)[200:300] > 0).all()


def test_rows_beyond_plain_numbers_are_named() -> None:
    """u below -30, and an interval that is 40 standard deviations from every mean: e^-800 of the mass."""
    mean, ends = np.array([[0.0, 0.0, 100.0]]), np.array([41.0, 41.0, 41.0])
    shape = np.zeros((1, 1)), mean, np.ones((1, 1))
    near = MixtureColumn(*shape, np.array([-1.0, -1.0, 40.0]), ends, (0, 1), np.ones((1, 1)), 1)
    assert search_quantiles(near, np.array([-31.0, 1.0, 1.0]))[1].tolist() == [False, True, False]


def test_derivatives_are_those_of_the_distribution_function() -> None:
    """By central differences, of components in x and in log x, on both sides."""
    column, step = draw_columns(np.random.default_rng(6), 2, 2, 40), 1e-4
    tail, _ = mixture_quantile._Tail.of(column, np.where(np.arange(40) % 2, 1.0, -1.0))
    x = tail.low + (tail.high - tail.low) * np.linspace(0.2, 0.6, 40)
    values, above, below = tail.evaluate(x), tail.evaluate(x + step), tail.evaluate(x - step)
    for known, plus, minus in zip(values[1:], above, below, strict=False):
        scale = np.abs(known).max()
        np.testing.assert_allclose((plus - minus) / (2 * step) / scale, known / scale, atol=1e-5)


def test_a_sum_over_components_is_in_their_order_however_many_columns_there_are() -> None:
    values = np.random.default_rng(0).standard_normal((40, 300))
    whole = sum_components(values)
    np.testing.assert_allclose(whole, values.sum(axis=0), atol=1e-12)
    assert all(sum_components(values[:, j : j + 1])[0] == whole[j] for j in range(300))


def test_a_search_that_starts_at_an_end_that_cuts_the_bulk_goes_on() -> None:
    """There the distribution function is 1 but for rounding, which says nothing of the way to the quantile."""
    n = 300
    column = draw_columns(np.random.default_rng(7), 5, 0, n)
    column = column._replace(high=column.low + 9.0)
    u = np.linspace(-6.0, -1e-3, n)
    tail, fits = mixture_quantile._Tail.of(column, np.ones(n))
    assert fits.all()
    ends = tail.evaluate(column.high)[0]
    assert np.count_nonzero((ends < 1.0) & (ends > 1.0 - 1e-14)) > 50
    found = search_quantiles(column, u)[0]
    for start in (column.high, np.nextafter(column.high, 0.0), column.low + 1e-6):
        np.testing.assert_allclose(mixture_quantile._solve(tail, u, start), found, rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_wild_mixtures_are_solved_wherever_the_first_guess_lies(seed: int) -> None:
    """Scales from 1e-3 to 1e3, intervals anywhere: Phi(u) lies between the masses at three floats to either side."""
    rng, n = np.random.default_rng(seed), 3000
    n_plain, n_log = ((3, 0), (2, 2), (0, 3), (12, 0))[seed]
    k = n_plain + n_log
    mean, scale = rng.normal(5.0, 20.0, (k, n)), np.exp(rng.normal(0.0, 2.0, (k, n)))
    mean[n_plain:], scale[n_plain:] = rng.normal(2.0, 1.5, (n_log, n)), np.exp(rng.normal(-1.0, 1.0, (n_log, n)))
    low = 10.0 ** rng.uniform(-2.0, 1.5, n)
    sizes = [size for size in (n_plain, n_log) if size]
    share = np.full((len(sizes), 1), 1.0 / len(sizes))
    high, edges = low + 10.0 ** rng.uniform(-2.0, 3.0, n), (0, *np.cumsum(sizes).tolist())
    column = MixtureColumn(rng.normal(0.0, 4.0, (k, n)), mean, scale, low, high, edges, share, n_plain)
    u = np.where(rng.random(n) < 0.5, rng.normal(0.0, 1.5, n), rng.uniform(-12.0, 12.0, n))
    x, fits = search_quantiles(column, u)
    tail, _ = mixture_quantile._Tail.of(column, np.where(u > 0.0, -1.0, 1.0))
    y, floats, wanted = tail.sign * x, 3.0 * np.spacing(x), special.ndtr(-np.abs(u))
    below, above = (tail.evaluate(np.clip(y + side, tail.low, tail.high))[0] for side in (-floats, floats))
    right = (below * (1.0 - 1e-11) <= wanted) & (wanted <= above * (1.0 + 1e-11))
    assert np.count_nonzero(fits) > 0.8 * n
    assert right[fits].all()


def test_a_search_that_starts_where_the_distribution_function_underflows_goes_on() -> None:
    """Near -38 standard deviations Phi is a number of few digits, or 0."""
    n = 41
    start = np.linspace(-39.0, -35.0, n)
    normal = np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1)), np.full(n, -400.0), np.full(n, 30.0)
    tail, _ = mixture_quantile._Tail.of(MixtureColumn(*normal, (0, 1), np.ones((1, 1)), 1), np.ones(n))
    np.testing.assert_allclose(mixture_quantile._solve(tail, np.full(n, -1.0), start), -1.0, rtol=1e-12)


@pytest.mark.parametrize("seed", [411970636, 1058462086])
def test_steps_from_where_the_distribution_function_nearly_underflows_are_not_trusted(seed: int) -> None:
    """Of 300 mixtures each, one search is led past its quantile by such a step."""
    rng, n = np.random.default_rng(seed), 300
    column = draw_columns(rng, int(rng.integers(2, 7)), 0, n)
    mean, scale = column.mean * float(rng.choice([1, 3, 10, 30])), column.scale * float(rng.choice([1, 0.3, 0.1]))
    column, u = column._replace(mean=mean, scale=scale), rng.normal(0.0, 8.0, n)
    x, fits = search_quantiles(column, u)
    tail, _ = mixture_quantile._Tail.of(column, np.where(u > 0.0, -1.0, 1.0))
    y, floats, wanted = tail.sign * x, 3.0 * np.spacing(np.abs(x)), special.ndtr(-np.abs(u))
    below, above = (tail.evaluate(np.clip(y + side, tail.low, tail.high))[0] for side in (-floats, floats))
    right = (below * (1.0 - 1e-11) <= wanted) & (wanted <= above * (1.0 + 1e-11))
    assert right[fits].all()
