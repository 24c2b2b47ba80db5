import numpy as np
import pytest
from scipy import stats

from benchmarks.estimators.driving_references import reference
from samplers.benchmark.driving_models import (
    car_following,
    cut_in,
    cut_in_front,
    cut_in_scenarios,
    follow,
    traffic_states,
)


@pytest.mark.parametrize(("model", "sd"), [(car_following, 1.7), (cut_in, 1.4)])
def test_reference_against_wide_draws(model, sd):
    state, n = model(), 40_000
    u = sd * np.random.default_rng(5).standard_normal((n, state.dim))
    log_weights = -0.5 * np.sum(u * u, axis=1) * (1 - sd**-2) + state.dim * np.log(sd)
    values = np.exp(log_weights) * (state.f(u) <= 0)
    error = values.std() / np.sqrt(n)
    assert error < 0.25 * state.p
    assert values.mean() == pytest.approx(state.p, abs=4 * error)


def test_reference_script():
    p, error = reference(cut_in(), 60_000, seed=3)
    assert p == pytest.approx(cut_in().p, abs=4 * error)
    assert error < 0.1 * p


@pytest.mark.parametrize("model", [car_following, cut_in])
def test_rows_stand_alone_and_values_are_times_to_collision(model):
    state = model()
    u = 2.0 * np.random.default_rng(6).standard_normal((100, state.dim))
    f = state.f(u)
    np.testing.assert_allclose([state.f(row[None])[0] for row in u], f, atol=1e-9)
    assert set(f[f <= 0]) == {-1.0}
    assert f.max() == 10.0


def test_car_following_school_physics():
    # lead speed, ego speed, gap
    faster_lead, hopeless, slow_approach = follow(np.array([[30.0, 25.0, 20.0], [5.0, 40.0, 10.0], [20.0, 21.0, 60.0]]))
    assert faster_lead == 10.0
    assert hopeless == -1.0
    assert slow_approach == 10.0
    # the first 0.6 s pass without a reaction: at 10 m/s closing speed and 5.5 m gap there is no time left
    assert follow(np.array([[15.0, 25.0, 5.5]]))[0] == -1.0


def test_cut_in_school_physics():
    far = [25.0, 25.0, 25.0, 80.0, 100.0, 3.5]
    into_the_ego = [40.0, 15.0, 25.0, 25.0, 100.0, 2.7]
    np.testing.assert_array_equal(cut_in_front(np.array([far, into_the_ego])), [10.0, -1.0])


def test_first_value_of_the_mixture_has_its_distribution():
    u = np.random.default_rng(7).standard_normal((20_000, 3))
    lead = traffic_states(u)[:, 0]

    def cdf(x):
        whole = 0.72 * stats.norm.cdf(x, 27.0, 3.2) + 0.28 * stats.norm.cdf(x, 22.0, 4.0)
        low, high = (0.72 * stats.norm.cdf(e, 27.0, 3.2) + 0.28 * stats.norm.cdf(e, 22.0, 4.0) for e in (5.0, 40.0))
        return (whole - low) / (high - low)

    # inverted exactly, far out too
    np.testing.assert_allclose(cdf(lead), stats.norm.cdf(u[:, 0]), rtol=1e-7)


def test_values_of_the_mixture_have_its_moments():
    x = traffic_states(np.random.default_rng(8).standard_normal((100_000, 3)))
    assert x.min(axis=0) == pytest.approx([5.0, 5.0, 4.0], abs=8.0)
    # cut at 4 m, the gap's mean rises a little over the mixture's 34.1 m
    np.testing.assert_allclose(x.mean(axis=0)[:2], [25.6, 26.3], atol=0.1)
    assert 34.1 < x[:, 2].mean() < 34.6
    assert np.corrcoef(x.T)[0, 1] == pytest.approx(0.88, abs=0.03)


def test_cut_in_scenarios_stay_in_range():
    x = cut_in_scenarios(4 * np.random.default_rng(9).standard_normal((5000, 6)))
    assert (x >= np.array([10, 8, 8, 2, 4, 2.6]) - 1e-4).all()
    assert (x <= np.array([42, 40, 40, 90, 110, 4.6]) + 1e-4).all()
