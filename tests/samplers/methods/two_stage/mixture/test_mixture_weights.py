import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from samplers.methods.two_stage.mixture.mixture_weights import Floor, minimise_second_moment, raise_to_floors


def random_problem(seed, k=6, n=300):
    """Log ratios of k Gaussians to N(0, I) at n points in two dimensions, and uneven weights."""
    rng = np.random.default_rng(seed)
    u, means, scales = rng.normal(2.0, 1.0, (n, 2)), rng.normal(2.0, 1.5, (k, 2)), rng.uniform(0.5, 1.5, k)
    square = ((u - means[:, None]) ** 2).sum(axis=2)
    log_r = 0.5 * (u * u).sum(axis=1) - 0.5 * square / scales[:, None] ** 2 - 2 * np.log(scales)[:, None]
    return log_r, rng.normal(-8.0, 1.0, n)


def second_moment(a, log_r, log_weights):
    return float((np.exp(log_weights) / (a @ np.exp(log_r))).sum())


def optimum(log_r, log_weights, floors):
    """The least second moment, by sequential quadratic programming."""
    k, ratio, w = len(log_r), np.exp(log_r), np.exp(log_weights - log_weights.max())

    def value(a):
        return float((w / (a @ ratio)).sum())

    def slope(a):
        return -ratio @ (w / (a @ ratio) ** 2)

    constraints = [{"type": "eq", "fun": lambda a: a.sum() - 1}]
    for floor in floors:
        constraints.append({"type": "ineq", "fun": lambda a, f=floor: a[f.members].sum() - f.least})
    start = np.full(k, 1 / k)
    scale = value(start)
    found = minimize(
        lambda a: value(a) / scale,
        start,
        jac=lambda a: slope(a) / scale,
        method="SLSQP",
        bounds=[(0, 1)] * k,
        constraints=constraints,
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert found.success
    return value(found.x) * np.exp(log_weights.max())


def only(k, *members):
    return np.isin(np.arange(k), members)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(
    "floors",
    [[], [Floor(only(6, 0), 0.1)], [Floor(only(6, 0, 1), 0.3)]],
    ids=["free", "one", "a pair"],
)
def test_weights_are_nearly_the_best(seed, floors):
    """60 steps come within 2 % of the least second moment."""
    log_r, log_weights = random_problem(seed)
    a = minimise_second_moment(log_r, log_weights, np.full(6, 1 / 6), floors)
    assert a.sum() == pytest.approx(1.0, abs=1e-12)
    assert (a >= 0).all()
    for floor in floors:
        assert a[floor.members].sum() >= floor.least - 1e-9
    assert second_moment(a, log_r, log_weights) <= 1.02 * optimum(log_r, log_weights, floors)


def test_a_component_that_fits_gets_everything_and_a_useless_one_nothing():
    """Points with density q_0: phi / q_0 is the same for all of them."""
    rng = np.random.default_rng(0)
    log_r = np.stack([np.full(200, 3.0), rng.normal(1.0, 0.5, 200), np.full(200, -np.inf)])
    a = minimise_second_moment(log_r, np.full(200, -5.0), np.full(3, 1 / 3), [])
    assert a[0] > 0.99
    assert a[2] == 0.0


def test_two_regions_are_weighed_by_the_root_of_their_second_moment():
    """Components that do not overlap: the least of sum_k m_k / a_k, with m_k = w n_k / r_k, is at a_k ~ sqrt(m_k)."""
    log_r = np.full((2, 50), -np.inf)
    log_r[0, :10], log_r[1, 10:] = 2.0, 0.5
    a = minimise_second_moment(log_r, np.zeros(50), np.array([0.5, 0.5]), [])
    expected = np.sqrt([10 * np.exp(-2.0), 40 * np.exp(-0.5)])
    np.testing.assert_allclose(a, expected / expected.sum(), rtol=1e-9)


def test_huge_logarithms_do_no_harm():
    log_r, log_weights = random_problem(3)
    a = minimise_second_moment(log_r, log_weights, np.full(6, 1 / 6), [])
    shifted = minimise_second_moment(log_r + 500, log_weights - 1500, np.full(6, 1 / 6), [])
    np.testing.assert_allclose(shifted, a, rtol=1e-6)


def test_points_of_no_weight_do_not_matter():
    log_r, log_weights = random_problem(4)
    more_r, more_weights = random_problem(5)
    a = minimise_second_moment(log_r, log_weights, np.full(6, 1 / 6), [])
    joined = np.concatenate([log_r, more_r], axis=1), np.concatenate([log_weights, more_weights - 100])
    np.testing.assert_array_equal(minimise_second_moment(*joined, np.full(6, 1 / 6), []), a)


mixtures = st.lists(st.floats(0, 1), min_size=4, max_size=10).filter(lambda w: sum(w) > 1e-3)


@given(mixtures, st.floats(0, 0.9))
def test_a_floor_is_kept_and_the_rest_keeps_its_proportions(weights, least):
    a = np.array(weights) / sum(weights)
    members = only(len(a), 0, 2)
    raised = raise_to_floors(a, [Floor(members, least)])
    assert raised.sum() == pytest.approx(1.0, abs=1e-9)
    assert raised[members].sum() >= least - 1e-9
    if a[members].sum() >= least:
        np.testing.assert_array_equal(raised, a)
    rest = a[~members].sum()
    if rest > 1e-6:
        np.testing.assert_allclose(raised[~members] / raised[~members].sum(), a[~members] / rest, atol=1e-9)


def test_a_floor_of_members_without_weight_is_dealt_out_evenly():
    raised = raise_to_floors(np.array([0.0, 0.0, 0.4, 0.6]), [Floor(only(4, 0, 1), 0.2)])
    np.testing.assert_allclose(raised, [0.1, 0.1, 0.32, 0.48])


def test_several_floors_are_kept():
    floors = [Floor(only(6, 0), 0.05), Floor(only(6, 2, 3), 0.4), Floor(only(6, 4), 0.1)]
    for seed in range(8):
        a = minimise_second_moment(*random_problem(seed), np.full(6, 1 / 6), floors)
        assert a.sum() == pytest.approx(1.0, abs=1e-12)
        for floor in floors:
            assert a[floor.members].sum() >= 0.999 * floor.least


@given(mixtures, st.floats(0.05, 2.0))
def test_floors_of_more_than_everything_are_lowered_in_proportion(weights, total):
    a = np.array(weights) / sum(weights)
    floors = [
        Floor(only(len(a), 0), 0.2 * total),
        Floor(only(len(a), 1), 0.3 * total),
        Floor(only(len(a), 2), 0.5 * total),
    ]
    raised = raise_to_floors(a, floors)
    assert raised.sum() == pytest.approx(1.0, abs=1e-9)
    assert (raised >= 0).all()
    if total >= 1:
        np.testing.assert_allclose(raised[:3], [0.2, 0.3, 0.5], atol=1e-9)
