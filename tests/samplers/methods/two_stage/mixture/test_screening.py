import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.mixture.screening import FailureScreen, LabelledPoints, draw_screened, train_screen
from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS
from samplers.proposals.components import IsotropicNormal

SETTINGS = DEFAULT_MIXTURE_SETTINGS.screening


class Coordinate:
    """A classifier whose decision is the first coordinate."""

    def decision_function(self, u):
        return u[:, 0]


SCREEN = FailureScreen(Coordinate(), intercept=0.0, slope=1.0, min_acceptance=0.25)


def test_acceptance_is_the_root_of_the_probability_of_failure():
    """Log odds t = u1: sqrt(1 / (1 + e^-t)), 0.25 at least."""
    u = np.array([[-50.0, 0.0], [-2.0, 1.0], [0.0, 5.0], [3.0, 0.0], [800.0, 0.0]])
    expected = np.maximum(np.sqrt(1 / (1 + np.exp(-u[:, 0]))), 0.25)
    np.testing.assert_allclose(SCREEN(u), expected, rtol=1e-12)


def test_the_root_of_the_probability_is_the_best_acceptance(rng):
    """E[y^2 / a] E[a] with y in {0, 1}, P[y = 1 | u] = pi: least at a ~ sqrt(pi) (Cauchy-Schwarz)."""
    pi = rng.random(1000)

    def second_moment(a):
        return (pi / a).mean() * a.mean()

    best = second_moment(np.sqrt(pi))
    assert best == pytest.approx(np.sqrt(pi).mean() ** 2)
    for power in (0.0, 0.3, 0.7, 1.0):
        assert second_moment(pi**power) > best


@pytest.mark.parametrize("n", [0, 1, 7, 3000])
def test_screened_draws_have_the_density_of_the_component_times_the_acceptance(n, rng):
    u = draw_screened(SCREEN, IsotropicNormal(2), n, rng)
    assert u.shape == (n, 2)
    if n < 100:
        return
    grid = np.linspace(-6, 6, 4001)
    density = stats.norm.pdf(grid) * SCREEN(np.column_stack([grid, grid]))
    cdf = np.cumsum(density) / density.sum()
    assert stats.kstest(u[:, 0], lambda x: np.interp(x, grid, cdf)).pvalue > 1e-4
    assert stats.kstest(u[:, 1], "norm").pvalue > 1e-4


def labelled(rng, n, fails):
    u = rng.normal(0, 1.5, (n, 2))
    return LabelledPoints(u, fails(u))


def beyond(u):
    return u[:, 0] > 1.0


def test_a_screen_that_separates_accepts_failures_and_rejects_the_others(rng):
    """Half of the draws and more would not fail: it pays, and p-hat through it is unbiased."""
    known, fresh = labelled(rng, 600, beyond), labelled(rng, 600, beyond)
    screen = train_screen(known, fresh, np.zeros(600))
    assert screen is not None
    assert screen.min_acceptance in SETTINGS.min_acceptances
    u = rng.normal(0, 1.5, (4000, 2))
    accepted = screen(u)
    assert accepted[u[:, 0] > 1.5].mean() > 0.9
    assert accepted[u[:, 0] < 0.5].mean() < screen.min_acceptance + 0.1
    kept = draw_screened(screen, IsotropicNormal(2, 1.5), 4000, rng)
    weights = np.where(beyond(kept), accepted.mean() / screen(kept), 0.0)
    error = math.hypot(weights.std() / math.sqrt(4000), weights.mean() * accepted.std() / accepted.mean() / 63)
    assert weights.mean() == pytest.approx(stats.norm.sf(1 / 1.5), abs=4 * error)


def test_no_screen_without_points_of_both_classes(rng):
    good = labelled(rng, 600, beyond)
    few = LabelledPoints(good.u, np.arange(600) < SETTINGS.min_class_size - 1)
    for known, fresh in ((few, good), (good, few), (good, LabelledPoints(good.u, np.ones(600, dtype=bool)))):
        assert train_screen(known, fresh, np.zeros(600)) is None


def test_no_screen_where_failure_is_a_matter_of_chance(rng):
    """The classifier learns nothing: there is no variance to be saved."""

    def chance(u):
        return rng.random(len(u)) < 0.5

    assert train_screen(labelled(rng, 400, chance), labelled(rng, 400, chance), np.zeros(400)) is None


def test_no_screen_where_the_spread_is_that_of_the_weights(rng):
    """Nine in ten draws fail: without the others the mean of log-normal weights is hardly more certain."""

    def nearly_all(u):
        return u[:, 0] > -2.0

    log_weights = rng.normal(0, 1.5, 800)
    assert train_screen(labelled(rng, 800, nearly_all), labelled(rng, 800, nearly_all), log_weights) is None


def test_a_machine_is_trained_on_so_many_points_at_most(rng):
    """Of 3,000 points 500, at equal distances; with room for all of them nothing changes."""
    known, fresh = labelled(rng, 3000, beyond), labelled(rng, 600, beyond)
    few = train_screen(known, fresh, np.zeros(600), replace(SETTINGS, svm_points=500))
    whole, roomy = (train_screen(known, fresh, np.zeros(600), replace(SETTINGS, svm_points=n)) for n in (3600, 10**6))
    assert few.classifier.shape_fit_ == (500, 2)
    assert whole.classifier.shape_fit_ == (3600, 2)
    u = rng.normal(0, 1.5, (1000, 2))
    np.testing.assert_array_equal(whole(u), roomy(u))
    assert few(u)[u[:, 0] > 1.5].mean() > 0.9 and few(u)[u[:, 0] < 0.5].mean() < few.min_acceptance + 0.1
