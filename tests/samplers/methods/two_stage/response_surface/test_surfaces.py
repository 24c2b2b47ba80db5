"""The regressions of f find its limit state where f is smooth and where it is the least of several functions."""

import numpy as np
import pytest

from samplers.methods.two_stage.response_surface.surfaces import fit_least_of_planes, fit_process, fit_surface


def portfolio(u):
    """A smooth f: 9 less four lognormal losses."""
    return 9 - np.exp(0.6 * u).sum(axis=1)


def series(u):
    """The least of three planes of unlike steepness."""
    return np.minimum(np.minimum(3 - u[:, 0], 4 * (3.2 - u[:, 1])), 0.5 * (3.4 + u[:, 2]))


def points(rng, n=3000, dim=4):
    """Wide draws, a third of which lie near the limit states here."""
    return 1.7 * rng.standard_normal((n, dim))


@pytest.mark.parametrize("f", [portfolio, series])
def test_the_better_of_both_regressions_tells_failures_from_the_others(f, rng):
    """Fresh points fall on the right side, and the accuracy that it states is about that of fresh points near."""
    x = points(rng)
    surface = fit_surface(x, f(x), rng)
    fresh = points(rng)
    right = (surface.predict(fresh) <= 0) == (f(fresh) <= 0)
    assert right.mean() > 0.98
    near = np.argsort(np.abs(f(fresh)))[:1200]
    assert surface.accuracy == pytest.approx(right[near].mean(), abs=0.03) and surface.accuracy > 0.95


def test_a_series_system_needs_pieces_and_a_smooth_sum_needs_kriging(rng):
    """The one kind is wrong twice as often as the other where f is of the other's kind."""
    x, fresh = points(rng), points(rng)
    for f, process_is_better in ((portfolio, True), (series, False)):
        near = np.argsort(np.abs(f(fresh)))[:1200]
        train = np.argsort(np.abs(f(x)))[:600]
        y = np.tanh(f(x)[train])
        wrong = [
            ((predict(fresh[near]) <= 0) != (f(fresh[near]) <= 0)).mean()
            for predict in (fit_process(x[train], y), fit_least_of_planes(x[train], y, rng))
        ]
        assert (2 * wrong[0] < wrong[1]) if process_is_better else (2 * wrong[1] < wrong[0])


@pytest.mark.parametrize("y", [np.ones(600), -np.ones(600), np.zeros(600)], ids=["safe", "failing", "zero"])
def test_no_surface_without_points_on_both_sides(y, rng):
    """There is no limit state to be found."""
    assert fit_surface(rng.standard_normal((600, 3)), y, rng) is None


def test_the_same_seed_gives_the_same_surface(rng):
    """Nothing is random but by the generator."""
    x = points(rng, 900)
    first, second = (fit_surface(x, series(x), np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(first.predict(x), second.predict(x)) and first.accuracy == second.accuracy
