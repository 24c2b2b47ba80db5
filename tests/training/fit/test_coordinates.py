"""Mixtures and coordinate systems: known truth, what is rejected, which system is chosen; refits of whole clusters."""

from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.mixture import GaussianMixture

from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.scenarios.registry import find_scenario
from training.fit import coordinates as module
from training.fit import mixture as mixture_fit
from training.fit.coordinates import (
    COORDINATE_SYSTEMS,
    FOLD_STARTS,
    Asked,
    choose_system,
    draw_events,
    fit_system,
    held_out_log_prob,
    refit,
)
from training.fit.filters import EventSet, recorded_parameters
from training.fit.mixture import EM_ITERATIONS, SMALLEST_COMPONENT, TOLERANCE, fit_mixture, select_mixture


def test_a_component_on_a_handful_of_events_is_rejected(quick):
    rng = np.random.default_rng(0)
    few = 2 * SMALLEST_COMPONENT - 4
    far = np.array([60.0, 60.0]) + 0.01 * rng.standard_normal((few, 2))
    points = np.concatenate([rng.standard_normal((200, 2)), far])
    mixture, candidates = select_mixture(points)
    second = candidates[1]
    assert second.smallest == pytest.approx(few)
    assert second.bic < candidates[0].bic and not second.accepted
    chosen = min((c for c in candidates if c.accepted), key=lambda c: c.bic)
    assert len(mixture.weights) == chosen.number


def test_few_events_get_one_component_and_too_few_an_error():
    points = np.random.default_rng(0).standard_normal((15, 6))
    assert len(select_mixture(points)[1]) == 1
    with pytest.raises(ValueError, match="6 events are too few to fit 6 parameters"):
        select_mixture(points[:6])


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(0)
    spread = np.array([[1.0, 0.5, 0.0], [0.0, 0.6, 0.2], [0.0, 0.0, 0.3]])
    x = np.concatenate([rng.standard_normal((150, 3)) @ spread, 1.5 + 0.4 * rng.standard_normal((60, 3))])
    return (x - x.mean(axis=0)) / x.std(axis=0)


@pytest.mark.parametrize(("components", "seed"), [(1, 0), (4, 2)])
def test_a_start_leads_where_it_does_in_an_independent_implementation(points, components, seed):
    """The same k-means clusters, steps and rule of convergence: equal up to rounding."""
    settings = {"tol": TOLERANCE, "reg_covar": 0.01, "max_iter": EM_ITERATIONS, "n_init": 1, "random_state": seed}
    model = GaussianMixture(components, **settings).fit(points)
    fit, likelihood = fit_mixture(points, components, floor=0.01, seed=seed, starts=1)
    np.testing.assert_allclose(fit.weights, model.weights_, atol=1e-9)
    np.testing.assert_allclose(fit.means, model.means_, atol=1e-9)
    np.testing.assert_allclose(fit.covariances, model.covariances_, atol=1e-9)
    assert likelihood == pytest.approx(len(points) * model.score(points), rel=1e-12)


FOLLOWING = find_scenario("car_following").parameters
CUT_IN = recorded_parameters("cut_in")
PLAIN, LOG_GAP, CLOSING = COORDINATE_SYSTEMS["car_following"]
COMPONENT = ([1.0], [[15.0, 2.8, 0.0]], [np.diag([9.0, 0.16, 0.04])])
"""Speed, log gap, closing speed over the root of the gap."""


def closing_events(n, seed=0):
    x = TruncatedGaussianMixture(*COMPONENT, coordinates=CLOSING.coordinates(FOLLOWING)).sample(
        n, np.random.default_rng(seed)
    )
    return EventSet(x, np.arange(n) // 10)


def test_the_criterion_is_that_of_the_density_of_x(monkeypatch):
    """BIC = -2 log L + (number of parameters) log n, with L the likelihood of x itself; nobody is outside the box."""
    monkeypatch.setattr(mixture_fit, "COVARIANCE_FLOOR", 0.0)
    monkeypatch.setattr(module, "MAX_COMPONENTS", 1)
    events = closing_events(200)
    for system in (LOG_GAP, CLOSING):
        fit = fit_system(events, system, FOLLOWING)
        log_likelihood = float(fit.distribution.log_prob(events.joint).sum())
        # To what the ranges cut away (1e-4 of the mass), and six digits of the parameters.
        assert fit.bic == pytest.approx(-2.0 * log_likelihood + 9 * np.log(200), abs=0.5)


def test_events_choose_the_system_that_they_come_from(quick):
    events = closing_events(100)
    fits = [fit_system(events, system, FOLLOWING) for system in (PLAIN, LOG_GAP, CLOSING)]
    held_out = [held_out_log_prob(events, system, FOLLOWING) for system in (PLAIN, LOG_GAP, CLOSING)]
    assert choose_system([fit.bic for fit in fits], held_out, events.clusters) == 2
    assert fits[2].family == "1 component, closing speed / sqrt(gap), log gap"
    np.testing.assert_allclose(fits[2].distribution.means[0], COMPONENT[1][0], atol=4 * 3 / 20)


def test_held_out_events_are_not_in_the_fit(quick):
    """One cluster far from the others is predicted badly by them, though a fit to all events knows it."""
    events = closing_events(100)
    joint = events.joint.copy()
    joint[:10, 0] = 40.0 + 0.1 * np.arange(10)
    events = EventSet(joint, events.clusters)
    scores = held_out_log_prob(events, LOG_GAP, FOLLOWING)
    known = fit_system(events, LOG_GAP, FOLLOWING).distribution.log_prob(joint)
    assert scores[:10].max() < scores[10:].min()
    assert (known[:10] > scores[:10] + 2.0).all()


def test_columns_apart_are_independent(quick):
    rng = np.random.default_rng(1)
    joint = np.column_stack([rng.normal(15.0, 2.0, (60, 3)), rng.uniform(5.0, 40.0, (60, 2))])
    offsets = rng.normal(3.0, 0.4, 25)
    apart = np.column_stack([offsets, np.exp(1.5 + 0.3 * (offsets - 3.0) + rng.normal(0.0, 0.1, 25))])
    fit = fit_system(EventSet(joint, np.arange(60), apart), COORDINATE_SYSTEMS["cut_in"][2], CUT_IN)
    covariance, mean = fit.distribution.covariances[0], fit.distribution.means[0]
    assert (covariance[5:, :5] == 0.0).all()
    logs = np.column_stack([offsets, np.log(apart[:, 1])])
    np.testing.assert_allclose(mean[5:], logs.mean(axis=0), rtol=1e-5)
    # Up to the floor under variances, 1 % of each.
    np.testing.assert_allclose(covariance[5:, 5:], np.cov(logs.T, bias=True), rtol=0.011)


def test_events_of_a_cluster_err_together():
    """Losses of 1 in three clusters of ten and -0.5 in two: clearly worse only if each event were by itself."""
    clusters = np.repeat(np.arange(5), 10)
    loss = np.where(clusters < 3, 1.0, -0.5)
    assert loss.sum() / (np.sqrt(50) * loss.std(ddof=1)) > 2.0
    assert choose_system([20.0, 8.0], [np.zeros(50), -loss], clusters) == 1
    assert choose_system([20.0, 8.0], [np.zeros(50), -loss], np.arange(50)) == 0


def test_events_count_that_every_system_predicts_and_a_tie_is_decided_by_those_held_out():
    """The second one predicts half of them, and far worse; then all of them and a little worse."""
    alone, good = np.arange(50), np.zeros(50)
    half = np.where(alone < 25, np.nan, -10.0 + 0.01 * np.tile([1.0, -1.0], 25))
    assert choose_system([20.0, 8.0], [good, half], alone) == 0
    assert choose_system([10.0, 8.0], [np.full(50, np.nan)] * 2, alone) == 1
    noise = np.random.default_rng(0).standard_normal(50)
    assert choose_system([9.9, 8.0], [good, good - 0.01 + noise - noise.mean()], alone) == 0


def events(n, seed=0, per_cluster=1):
    rng = np.random.default_rng(seed)
    x = np.column_stack([rng.normal(15.0, 3.0, (n, 2)), np.exp(rng.normal(3.0, 0.4, n))])
    return EventSet(x, np.arange(n) // per_cluster)


def test_more_refits_where_the_number_of_components_differs(monkeypatch):
    monkeypatch.setattr(module, "N_REFITS", 4)
    monkeypatch.setattr(module, "MORE_REFITS", 7)
    for numbers, wanted in (([1, 1, 1, 1], 4), ([1, 2, 1, 1, 1, 1, 1], 7)):
        made = iter(numbers)

        def fit(*_, made=made):
            return SimpleNamespace(family=f"{next(made)} components", bic=0.0)

        monkeypatch.setattr(module, "fit_system", fit)
        families = [each.family for each in refit(events(25), [LOG_GAP], FOLLOWING, Asked())]
        assert families == [f"{number} components" for number in numbers[:wanted]]


@pytest.mark.slow
def test_coordinates_are_chosen_anew_in_each_refit(quick):
    """By the BIC of the events drawn; 400 events of logarithms of gaps leave no doubt."""
    systems = COORDINATE_SYSTEMS["car_following"][:2]
    few, many = (refit(events(n, seed=1), systems, FOLLOWING, Asked(6)) for n in (25, 400))
    assert {each.system.name for each in many} == {"log gap"}
    drawn = draw_events(events(25, seed=1), np.random.default_rng(0))
    criteria = [fit_system(drawn, system, FOLLOWING, 0, FOLD_STARTS).bic for system in systems]
    assert few[0].bic == min(criteria)
    assert few[0].system is systems[int(np.argmin(criteria))]


def test_refits_follow_the_seed_and_few_clusters_have_none(quick):
    told = []
    one = refit(events(30), [LOG_GAP], FOLLOWING, Asked(3, 3, told.append))
    other = refit(events(30), [LOG_GAP], FOLLOWING, Asked(3, 3))
    assert [fit.distribution.to_dict() for fit in one] == [fit.distribution.to_dict() for fit in other]
    assert told == [f"refit {number} of 3" for number in (1, 2, 3)]
    assert refit(events(40, per_cluster=10), [LOG_GAP], FOLLOWING, Asked()) == ()


def test_clusters_are_drawn_whole_and_columns_apart_by_themselves():
    recorded = events(60, per_cluster=3)
    original, apart = recorded.joint, np.arange(15.0)[:, None]
    drawn = draw_events(EventSet(original, recorded.clusters, apart), np.random.default_rng(1))
    assert drawn.apart.shape == (15, 1) and 5 < len(np.unique(drawn.apart)) < 15
    assert len(drawn.joint) == 60
    assert len(np.unique(drawn.clusters)) == 20  # one drawn twice counts as two
    for label in np.unique(drawn.clusters):
        rows = drawn.joint[drawn.clusters == label]
        first = int(np.flatnonzero((original == rows[0]).all(axis=1))[0])
        assert first % 3 == 0
        assert (rows == original[first : first + 3]).all()
