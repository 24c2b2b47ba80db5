from dataclasses import replace

import numpy as np
import pytest

from samplers.methods.two_stage.terms.fitting import (
    choose_guards,
    find_axes,
    first_law,
    fit_law,
    near_points,
    temper_weights,
)
from samplers.methods.two_stage.terms.history import TermHistory
from samplers.methods.two_stage.terms.settings import LawSettings, RoundSettings
from samplers.methods.two_stage.terms.walks import Directions
from samplers.statistics.weights import effective_number

SETTINGS = LawSettings()


def test_axes_span_the_directions_and_no_more(rng):
    plane = np.linalg.qr(rng.standard_normal((30, 2)))[0]
    directions = rng.standard_normal((9, 2)) @ plane.T
    axes = find_axes(directions, np.ones(9), SETTINGS)
    assert axes.shape == (30, 2)
    np.testing.assert_allclose(axes.T @ axes, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(axes @ axes.T @ plane, plane, atol=1e-10)


def test_heavier_directions_come_first():
    axes = find_axes(np.eye(3), np.array([1.0, 3.0, 2.0]), replace(SETTINGS, rank=2))
    np.testing.assert_allclose(np.abs(axes), np.eye(3)[:, [1, 2]], atol=1e-12)


def test_directions_in_which_a_term_hardly_changes_are_left_out():
    axes = find_axes(np.eye(3), SETTINGS.least_singular * np.array([20.0, 1.1, 0.9]), SETTINGS)
    np.testing.assert_allclose(np.abs(axes), np.eye(3)[:, :2], atol=1e-12)


def test_the_first_law_lies_around_the_ends(rng):
    """24 ends at distance 4 along one axis: mean 4 there; the covariance is (24 S + 20 I) / 44."""
    ends = rng.standard_normal((24, 10))
    ends[:, 0] = 4.0
    law = first_law(np.eye(10)[:, :2], ends, ends[:0], SETTINGS)
    bump = law.groups[0].components[0]
    np.testing.assert_allclose(bump.centre, ends[:, :2].mean(axis=0))
    s = ends[:, 1].var()
    np.testing.assert_allclose(np.sort(bump.variance), np.sort([20 / 44, (24 * s + 20) / 44]))
    assert sum(group.share for group in law.groups) == pytest.approx(1.0)


def test_a_law_is_fitted_to_weighted_failures(rng):
    """500 draws beyond a plane, half of them with weight 0: the mean is that of the others; 5 standard errors."""
    z = 4.0 + 0.25 * rng.exponential(size=500)
    u = rng.standard_normal((500, 20))
    u[:, 0] = z
    u[:250, 1] += 6.0
    log_weights = np.where(np.arange(500) < 250, -60.0, 0.0)
    law = fit_law(np.eye(20)[:, :2], u, log_weights, u[:0], u[:0], SETTINGS, rng)
    *bumps, tempered, _ = law.groups  # the last is around the heaviest
    share = sum(bump.share for bump in bumps)
    centre = sum(bump.share * bump.components[0].centre for bump in bumps) / share
    np.testing.assert_allclose(centre, [4.25, 0.0], atol=5 * 1.0 / np.sqrt(250))
    assert share / tempered.share == pytest.approx(SETTINGS.bump_share / SETTINGS.tempered_share)


def test_the_mean_follows_heavy_points_and_the_covariance_many(rng):
    """Draws beyond 4 weighted towards 3: the mean is nearer to 3 than that of the points which the covariance has."""
    u = rng.standard_normal((600, 12))
    u[:, 0] = 4.0 + 0.5 * rng.standard_normal(600)
    log_weights = -4.0 * u[:, 0]
    law = fit_law(np.eye(12)[:, :2], u, log_weights, u[:0], u[:0], SETTINGS, rng)
    bump = law.groups[0].components[0]
    few, many = (temper_weights(log_weights, ess) for ess in (SETTINGS.mean_ess, SETTINGS.shape_ess))
    assert few @ u[:, 0] < many @ u[:, 0] - 0.2
    np.testing.assert_allclose(bump.centre, few @ u[:, :2])
    np.testing.assert_allclose(bump.variance.max(), 1.0, atol=5 * np.sqrt(2 / SETTINGS.shape_ess))


@pytest.mark.parametrize("wanted", [5.0, 40.0])
def test_weights_are_tempered_no_more_than_needed(rng, wanted):
    log_weights = 4 * rng.standard_normal(200)
    weights = temper_weights(log_weights, wanted)
    assert weights.sum() == pytest.approx(1.0)
    assert effective_number(weights) == pytest.approx(wanted, rel=1e-3)
    assert (np.argsort(weights) == np.argsort(log_weights)).all()
    np.testing.assert_allclose(temper_weights(np.zeros(200), wanted), 1 / 200)


def test_points_to_fit_to_are_failures_or_a_level(half_spaces, rng):
    """Of 600 base draws a term with p = 0.1 has 60 failures; one that nobody reaches has its 15 lowest values."""
    problem, _, normals = half_spaces(20, 0.1, shares=(1.0, 1e-7))
    u = rng.standard_normal((600, 20))
    history = TermHistory.of_base_draws(u, problem.terms(u))
    near = near_points(history, 0, 0.0, RoundSettings())
    assert near.ready and near.likely.all() and len(near.rows) == int((problem.terms(u).values[:, 0] <= 0).sum())
    near = near_points(history, 1, 0.0, RoundSettings())
    assert not near.ready and near.likely.all()
    assert set(near.rows) == set(np.argsort(-u @ normals[1])[:15])


def test_few_failures_have_the_points_of_a_level_beside_them(half_spaces, rng):
    """Of 600 base draws a term with p = 0.02 has about 12 failures, all likely, and 3 of the lowest others."""
    problem, _, normals = half_spaces(20, 0.02, shares=(1.0, 1e-7))
    u = rng.standard_normal((600, 20))
    near = near_points(TermHistory.of_base_draws(u, problem.terms(u)), 0, 0.0, RoundSettings())
    failures = int((problem.terms(u).f <= 0).sum())
    assert 6 <= failures < 15 and near.ready
    np.testing.assert_array_equal(near.rows, np.argsort(-u @ normals[0])[:15])
    np.testing.assert_array_equal(near.likely, np.arange(15) < failures)


def test_the_mean_is_that_of_the_likely_points(rng):
    """30 failures around 4, 60 points of a level around 3: the mean is 4, a slab of sd 0.3 is seen in all of them."""
    u = rng.standard_normal((90, 12))
    u[:, 0] = np.where(np.arange(90) < 30, 4.0, 3.0) + 0.1 * rng.standard_normal(90)
    u[:, 1] *= 0.3
    likely = np.arange(90) < 30
    law = fit_law(np.eye(12)[:, :2], u, np.zeros(90), u[:0], u[:0], SETTINGS, rng, likely)
    bumps = [group.components[0] for group in law.groups[:-2]]
    shares = np.array([group.share for group in law.groups[:-2]])
    centre = shares @ [bump.centre for bump in bumps] / shares.sum()
    np.testing.assert_allclose(centre, u[likely, :2].mean(axis=0), atol=1e-9)
    around = np.array([component.centre for component in law.groups[-1].components])
    assert (around[:, 0] > 0.9 * 3.6).all()  # 0.9 times a failure each


def test_a_component_without_likely_points_is_left_out(rng):
    """All 200 failures lie on one side, 200 points of a level on the other."""
    u = rng.standard_normal((400, 3))
    likely = np.arange(400) < 200
    u[:, 0] += np.where(likely, 60.0, -60.0)
    law = fit_law(np.eye(3), u, np.zeros(400), u[:0], u[:0], SETTINGS, rng, likely)
    assert all(group.share > 0 and (group.weights > 0).all() for group in law.groups)
    assert all(group.components[0].centre[0] > 0 for group in law.groups[:-2])


def test_the_heaviest_points_and_ends_are_guarded(rng):
    """One point of weight 50 stands apart from 60 others: it gets a Gaussian, and the first ends the places left."""
    u, ends = rng.standard_normal((61, 5)) + 3.0, np.full((40, 5), 2.0)
    u[7] = -4.0
    log_weights = np.zeros(61)
    log_weights[7] = np.log(50.0)
    law = fit_law(np.eye(5), u, log_weights, ends, u[:0], SETTINGS, rng)
    centres = np.array([component.centre for component in law.groups[-1].components])
    np.testing.assert_allclose(centres[0], SETTINGS.end_mean * u[7])
    np.testing.assert_allclose(centres[SETTINGS.max_heavy :], SETTINGS.end_mean * ends[0] * np.ones((12, 5)))
    assert len(centres) == SETTINGS.max_ends
    own = law.groups[-1].components[0].log_ratio(u[7:8])[0] + np.log(SETTINGS.end_share / SETTINGS.max_ends)
    assert law.log_ratio(u[7:8])[0] >= own


def test_a_slab_keeps_its_width(rng):
    """Failures beyond 4 within 0.2 of a plane: a tenth of I in their covariance would make a variance of 0.04 0.14."""
    u = rng.standard_normal((80, 20))
    u[:, 0] = 4.0 + 0.25 * abs(u[:, 0])
    u[:, 1] *= 0.2
    law = fit_law(np.eye(20)[:, :8], u, np.zeros(80), u[:2], u[:0], SETTINGS, rng)
    across = np.eye(8)[1]
    bump, tempered, around = (group.components[0] for group in law.groups)
    width = [float((one.axes.T @ across) ** 2 @ one.variance) for one in (bump, tempered, around)]
    # raised by two standard errors of a variance of 80 points, and up to four of chance
    assert 0.04 <= width[0] <= 0.04 * (1 + 6 * np.sqrt(2 / 80))
    factors = np.array([SETTINGS.tempered_variance, SETTINGS.end_variance])
    np.testing.assert_allclose(width[1:], factors * width[0], rtol=0.05)  # other variances end at 1


def test_half_spaces_apart_from_each_other_are_guarded(rng):
    """Planes at 3, 4 and 5 along three axes, one of them known twice, and one gradient far from any failure."""
    distance = np.array([4.0, 3.0, 5.0, 4.1, np.nan])
    unit = -np.eye(6)[[0, 1, 2, 0, 3]]
    directions = Directions(np.zeros(5, dtype=int), unit, -distance[:, None] * unit)
    guards = choose_guards(directions, SETTINGS)
    np.testing.assert_allclose(guards, np.diag([4.0, 3.0, 5.0, 0, 0, 0])[[1, 0, 2]])
    law = first_law(np.eye(6)[:, :3], rng.standard_normal((9, 6)), guards, SETTINGS)
    beyond = np.array([[0.0, 0.0, 5.5, 1.0, -1.0, 2.0]])
    ratio = law.groups[-1].share / 3 * np.exp(5.0 * 5.5 - 5.0**2 / 2)  # N(m, I) / N(0, I)
    assert law.groups[-1].share == pytest.approx(SETTINGS.guard_share)
    assert law.log_ratio(beyond)[0] >= np.log(ratio)
    assert len(choose_guards(directions, replace(SETTINGS, max_guards=1))) == 1
