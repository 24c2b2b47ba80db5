"""Refits: clusters are drawn whole, everything is fitted again, and their spread is that of the fit."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from rare_envs.scenarios.registry import scenario_named
from training.scenario_fitting import mixture as mixture_fit
from training.scenario_fitting import refits as refits_module
from training.scenario_fitting.coordinate_systems import COORDINATE_SYSTEMS, FOLD_STARTS, SYSTEMS_APART, fit_system
from training.scenario_fitting.event_filters import EventSet
from training.scenario_fitting.refits import describe_family, draw_events, refit

FOLLOWING = scenario_named("car_following").parameters
LOG_GAP = COORDINATE_SYSTEMS["car_following"][1]


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(mixture_fit, "EM_STARTS", 1)


def events(n, seed=0, per_cluster=1):
    rng = np.random.default_rng(seed)
    x = np.column_stack([rng.normal(15.0, 3.0, (n, 2)), np.exp(rng.normal(3.0, 0.4, n))])
    return EventSet(x, np.arange(n) // per_cluster)


def test_clusters_are_drawn_whole():
    drawn = draw_events(events(60, per_cluster=3), np.random.default_rng(1))
    original = events(60, per_cluster=3).joint
    assert len(drawn.joint) == 60
    assert len(np.unique(drawn.clusters)) == 20  # one drawn twice counts as two
    for label in np.unique(drawn.clusters):
        rows = drawn.joint[drawn.clusters == label]
        first = int(np.flatnonzero((original == rows[0]).all(axis=1))[0])
        assert first % 3 == 0
        assert (rows == original[first : first + 3]).all()


def test_columns_apart_are_drawn_by_themselves():
    base = events(20)
    apart = np.arange(15.0)[:, None]
    drawn = draw_events(EventSet(base.joint, base.clusters, apart), np.random.default_rng(0))
    assert drawn.apart.shape == (15, 1)
    assert 5 < len(np.unique(drawn.apart)) < 15


def test_the_spread_is_the_standard_error_of_the_mean(quick):
    """Of n independent events: sd / sqrt(n), here from 40 refits, so to 11 % (two standard errors 23 %)."""
    n = 200
    recorded = events(n)
    fits = [each.distribution for each in refit(recorded, [LOG_GAP], FOLLOWING, n=40)]
    means = np.array([fit.weights @ fit.means[:, 0] for fit in fits])
    assert means.std(ddof=1) == pytest.approx(recorded.joint[:, 0].std() / np.sqrt(n), rel=0.3)


def test_more_refits_where_the_number_of_components_differs(monkeypatch):
    monkeypatch.setattr(refits_module, "N_REFITS", 4)
    monkeypatch.setattr(refits_module, "MORE_REFITS", 7)
    for numbers, wanted in (([1, 1, 1, 1], 4), ([1, 2, 1, 1, 1, 1, 1], 7)):
        made = iter(numbers)

        def fit(*_, made=made):
            return SimpleNamespace(family=f"{next(made)} components", bic=0.0, bic_apart=0.0)

        monkeypatch.setattr(refits_module, "fit_system", fit)
        families = [each.family for each in refit(events(25), [LOG_GAP], FOLLOWING)]
        assert families == [f"{number} components" for number in numbers[:wanted]]


def test_components_are_selected_anew_in_each_refit(quick):
    """Two kinds of traffic, 60 pairs each, 20 m/s apart, more than six standard deviations."""
    one = events(60)
    other = one.joint + np.array([20.0, 20.0, 0.0])
    both = EventSet(np.concatenate([one.joint, other]), np.arange(120))
    assert {len(each.distribution.weights) for each in refit(both, [LOG_GAP], FOLLOWING, n=3)} == {2}


def test_coordinates_are_chosen_anew_in_each_refit(quick):
    """By the BIC of the events drawn; 400 events of logarithms of gaps leave no doubt."""
    systems = COORDINATE_SYSTEMS["car_following"][:2]
    few, many = (refit(events(n, seed=1), systems, FOLLOWING, n=6) for n in (25, 400))
    assert {each.system.name for each in many} == {"log gap"}
    drawn = draw_events(events(25, seed=1), np.random.default_rng(0))
    criteria = [fit_system(drawn, system, FOLLOWING, 0, FOLD_STARTS).bic for system in systems]
    assert few[0].bic == min(criteria)
    assert few[0].system is systems[int(np.argmin(criteria))]


def test_coordinates_of_the_columns_apart_are_chosen_anew_in_each_refit(quick):
    """Log-normal durations of 20 changes leave it open in which coordinate they are normal, those of 300 do not."""
    cut_in, rng = scenario_named("cut_in").parameters, np.random.default_rng(0)
    joint = np.column_stack([rng.normal(15.0, 2.0, (40, 3)), rng.uniform(5.0, 40.0, (40, 2))])
    apart = np.column_stack([rng.normal(3.2, 0.2, 300), np.exp(rng.normal(1.6, 0.25, 300))])
    systems = [COORDINATE_SYSTEMS["cut_in"][1].combine(each) for each in SYSTEMS_APART["duration"]]
    few, many = (
        Counter(fit.system.name for fit in refit(EventSet(joint, np.arange(40), apart[:n]), systems, cut_in, n=12))
        for n in (20, 300)
    )
    assert many == {"log gaps, log duration": 12}
    assert set(few) == {"log gaps, plain duration", "log gaps, log duration"}


def test_the_family_says_in_which_coordinates_refits_are():
    log, plain = (SimpleNamespace(system=system) for system in COORDINATE_SYSTEMS["car_following"][1::-1])
    assert describe_family("1 component, log gap", [log, log]) == "1 component, log gap"
    assert describe_family("1 component, log gap", [plain, log, log]) == (
        "1 component, log gap; of the refits 2 in log gap, 1 in plain"
    )


def test_same_seed_same_refits(quick):
    one, other = (refit(events(30), [LOG_GAP], FOLLOWING, seed=3, n=3) for _ in range(2))
    assert [fit.distribution.to_dict() for fit in one] == [fit.distribution.to_dict() for fit in other]


def test_few_clusters_have_no_refits(quick):
    assert refit(events(40, per_cluster=10), [LOG_GAP], FOLLOWING) == ()
