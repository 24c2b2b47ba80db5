import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp

from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS
from samplers.methods.two_stage.mixture.subspace_em import (
    GroupedPoints,
    fit_shrunk_subspace_gaussian,
    fit_subspace_mixture,
    inflate_variances,
    refit_components,
    truncate_weights,
)
from samplers.proposals.components import SubspaceGaussian, log_ratios

N = 20_000
HIGH_DIM = DEFAULT_MIXTURE_SETTINGS.subspace.high_dim


def covariance_of(component):
    """In all directions: the identity outside the axes."""
    return np.eye(len(component.axes)) + (component.axes * (component.variance - 1)) @ component.axes.T


def equal(u, groups=None):
    n = len(u)
    return GroupedPoints(u, np.full(n, 1 / n), float(n), np.arange(n) if groups is None else groups)


def gaussian(n, mean, covariance, rng):
    return rng.multivariate_normal(mean, covariance, n, method="cholesky")


MEAN = np.array([2.0, -1.0, 0.5])
COVARIANCE = np.array([[1.5, 0.6, 0.0], [0.6, 1.2, 0.3], [0.0, 0.3, 2.0]])


def test_a_known_gaussian_is_recovered(rng):
    component, share = fit_shrunk_subspace_gaussian(gaussian(N, MEAN, COVARIANCE, rng), np.full(N, 1 / N), N)
    error = np.sqrt(np.outer(np.diag(COVARIANCE), np.diag(COVARIANCE)) * 2 / N)
    np.testing.assert_allclose(component.centre, MEAN, atol=4 * math.sqrt(2.0 / N))
    # two standard errors of caution and the shrinkage, itself a standard error or so, on top of four
    assert (np.abs(covariance_of(component) - COVARIANCE) < 8 * error).all()
    assert share < 0.01


def test_weighted_points_are_worth_what_they_stand_for(rng):
    """Draws from N(0, 4 I), weighted to N(m, C) with C under 4 I."""
    u = 2 * rng.standard_normal((10 * N, 3))
    log_w = -0.5 * np.einsum("ij,jk,ik->i", u - MEAN, np.linalg.inv(COVARIANCE), u - MEAN) + (u * u).sum(axis=1) / 8
    w = np.exp(log_w - logsumexp(log_w))
    ess = 1 / float(w @ w)
    assert ess > 5000
    component, _ = fit_shrunk_subspace_gaussian(u, w, ess)
    np.testing.assert_allclose(component.centre, MEAN, atol=5 * math.sqrt(2.0 / ess))
    np.testing.assert_allclose(covariance_of(component), COVARIANCE, atol=8 * 2.0 * math.sqrt(2 / ess))


def target_of(u):
    mean = u.mean(axis=0)
    v = mean / np.linalg.norm(mean)
    return np.eye(u.shape[1]) + (np.mean((u @ v - np.linalg.norm(mean)) ** 2) - 1) * np.outer(v, v)


def test_with_few_points_the_covariance_is_the_target(rng):
    """Standard normal points far from the origin: the fewer, the nearer to one special direction, else N(0, I)."""
    shares, errors, plain_errors = [], [], []
    for n in (8, 40, 400):
        fits = [rng.standard_normal((n, 6)) + np.array([4.0, 0, 0, 0, 0, 0]) for _ in range(30)]
        components = [fit_shrunk_subspace_gaussian(u, np.full(n, 1 / n), n) for u in fits]
        shares.append(np.mean([share for _, share in components]))
        errors.append(np.mean([((covariance_of(component) - np.eye(6)) ** 2).sum() for component, _ in components]))
        plain_errors.append(np.mean([((np.cov(u.T) - np.eye(6)) ** 2).sum() for u in fits]))
    assert shares[0] > 0.9  # the truth is the target (nearly): most of it at any size
    assert (np.array(errors) < 0.6 * np.array(plain_errors)).all()
    u = rng.standard_normal((3, 6)) + 2.0
    component, share = fit_shrunk_subspace_gaussian(u, np.full(3, 1 / 3), 3)
    if share == 1.0:
        across = np.linalg.eigvalsh(covariance_of(component))
        assert np.count_nonzero(np.abs(across - 1) < 1e-9) >= 5


def test_shrinkage_goes_away_with_the_number_of_points(rng):
    covariance = np.diag([0.2, 3.0, 1.0, 0.5, 1.0, 2.0])
    shares = []
    for n in (10, 100, 1000, 10_000):
        u = gaussian(n, np.full(6, 1.0), covariance, rng)
        shares.append(fit_shrunk_subspace_gaussian(u, np.full(n, 1 / n), n)[1])
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.5
    assert shares[-1] < 0.01


@pytest.mark.parametrize("dim", [1, 2, 5, HIGH_DIM, HIGH_DIM + 1, 300])
@pytest.mark.parametrize("n", [1, 2, 5, 50])
def test_axes_are_orthonormal_and_variances_positive_however_few_the_points(dim, n, rng):
    for u in (rng.standard_normal((n, dim)) + 1.0, np.ones((n, dim)), np.zeros((n, dim))):
        component, share = fit_shrunk_subspace_gaussian(u, np.full(n, 1 / n), max(n, 2))
        np.testing.assert_allclose(component.axes.T @ component.axes, np.eye(component.axes.shape[1]), atol=1e-9)
        assert (component.variance > 0).all()
        assert 0 <= share <= 1
        assert component.axes.shape[1] == (dim if dim <= HIGH_DIM else 1)


def test_in_many_dimensions_the_length_of_the_mean_is_corrected_for_noise():
    """The mean of 100 points of N(4 e1, I) in 200 dimensions is too long by 0.24, and turned: along its own direction
    the distribution's mean is that much shorter than 4. Over 50 fits, each with a standard error of 0.1."""
    rng = np.random.default_rng(0)
    first, even = 4.0 * np.eye(200)[0], np.full(100, 0.01)
    components = [
        fit_shrunk_subspace_gaussian(rng.standard_normal((100, 200)) + first, even, 100)[0] for _ in range(50)
    ]
    excess = [component.mean[0] - first @ component.axes[:, 0] for component in components]
    assert np.mean(excess) == pytest.approx(0.0, abs=4 * 0.1 / math.sqrt(50))
    assert all(component.variance[0] <= 4.0 for component in components)


variances = st.lists(st.floats(0, 100), min_size=1, max_size=8)


@given(variances, st.floats(0.1, 1e6))
def test_caution_never_lowers_a_variance_and_leaves_large_ones(values, ess):
    variance = np.array(values)
    raised = inflate_variances(variance, ess)
    assert (raised >= variance).all()
    assert (raised > 0).all()
    np.testing.assert_array_equal(raised[variance >= 1], variance[variance >= 1])
    assert (raised[variance < 1] <= 1).all()


def test_caution_is_two_standard_errors():
    np.testing.assert_allclose(inflate_variances(np.array([0.25]), 200.0), 0.25 * 1.2)
    np.testing.assert_array_equal(inflate_variances(np.array([0.9]), 2.0), 1.0)


def log_likelihood(components, mixing, u):
    """Mean log of the mixture's density over N(0, I)."""
    return float(logsumexp(log_ratios(components, u), axis=0, b=np.asarray(mixing)[:, None]).mean())


def two_clusters(rng, n=400, apart=6.0):
    centre = np.array([apart / 2, 2.0])
    return np.concatenate([rng.standard_normal((n, 2)) + centre, 0.6 * rng.standard_normal((n, 2)) + centre * [-1, 1]])


def test_two_clusters_are_two_components():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        u = two_clusters(rng)
        mix = fit_subspace_mixture(equal(u), 8, rng)
        assert len(mix.components) == 2
        first, second = sorted(mix.components, key=lambda component: component.centre[0])
        np.testing.assert_allclose(first.centre, [-3, 2], atol=4 * 0.6 / math.sqrt(400) + 0.02)
        np.testing.assert_allclose(second.centre, [3, 2], atol=4 / math.sqrt(400) + 0.02)
        np.testing.assert_allclose(first.variance, 0.36, atol=8 * 0.36 * math.sqrt(2 / 400))
        np.testing.assert_allclose(mix.weights, 0.5, atol=0.02)


def test_one_gaussian_is_one_component():
    """By BIC: a second one is not worth its parameters; a level of a per cent or so per fit."""
    numbers = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        u = gaussian(300, np.array([3.0, 0.0]), np.array([[0.5, 0.2], [0.2, 1.0]]), rng)
        numbers.append(len(fit_subspace_mixture(equal(u), 8, rng).components))
    assert numbers.count(1) >= 18


def test_no_more_components_than_asked_for_than_groups_or_than_points_carry(rng):
    u = two_clusters(rng)
    assert len(fit_subspace_mixture(equal(u), 1, rng).components) == 1
    assert len(fit_subspace_mixture(equal(u, np.zeros(len(u), dtype=int)), 8, rng).components) == 1
    few = GroupedPoints(u, np.full(len(u), 1 / len(u)), 7.0, np.arange(len(u)))
    assert len(fit_subspace_mixture(few, 8, rng).components) == 1


def test_points_of_a_chain_stay_together(rng):
    """Chains that each cover both clusters cannot be told apart; chains within one can."""
    u = two_clusters(rng, 200)
    within = np.repeat(np.arange(40), 10)
    across = np.tile(np.arange(40), 10)
    assert len(fit_subspace_mixture(equal(u, within)._replace(ess=80.0), 3, rng).components) == 2
    assert len(fit_subspace_mixture(equal(u, across)._replace(ess=80.0), 3, rng).components) == 1


def test_a_fit_is_nearly_as_likely_as_the_truth_and_more_than_one_component(rng):
    truth = [
        SubspaceGaussian(np.eye(2), np.array([3.0, 2.0]), np.ones(2)),
        SubspaceGaussian(np.eye(2), np.array([-3.0, 2.0]), np.full(2, 0.36)),
    ]
    u = two_clusters(rng, 2000)
    mix = fit_subspace_mixture(equal(u), 8, rng)
    # the maximum exceeds the truth by chi2_9 / (2 n); shrinkage and caution cost about as much
    assert log_likelihood(mix.components, mix.weights, u) > log_likelihood(truth, [0.5, 0.5], u) - 10 / len(u)
    assert log_likelihood(mix.components, mix.weights, u) > log_likelihood(
        [fit_shrunk_subspace_gaussian(u, np.full(4000, 1 / 4000), 4000)[0]], [1.0], u
    )


@pytest.mark.parametrize("seed", range(10))
def test_refitting_raises_the_likelihood(seed):
    """From components that are off by about a standard deviation, with many points."""
    rng = np.random.default_rng(seed)
    u = two_clusters(rng, 500)
    start = [
        SubspaceGaussian(np.eye(2), np.array([s * 3.0, 2.0]) + rng.uniform(-1.5, 1.5, 2), np.full(2, 1.5))
        for s in (1, -1)
    ]
    moved = start
    for _ in range(3):
        before, moved = moved, refit_components(moved, u, np.zeros(len(u)))
        assert log_likelihood(moved, [0.5, 0.5], u) > log_likelihood(before, [0.5, 0.5], u) - 10 / len(u)
    assert log_likelihood(moved, [0.5, 0.5], u) > log_likelihood(start, [0.5, 0.5], u) + 0.1


def test_refitting_leaves_a_component_without_points_alone(rng):
    near, far = (SubspaceGaussian(np.eye(3), np.full(3, m), np.full(3, v)) for m, v in ((0.5, 1.0), (-9.0, 0.7)))
    u = rng.standard_normal((300, 3)) + 1.0
    moved, left = refit_components([near, far], u, np.zeros(300))
    assert left is far
    np.testing.assert_allclose(moved.centre, 1.0, atol=4 / math.sqrt(300))


def test_one_heavy_point_does_not_take_a_component_with_it(rng):
    """Its weight is tempered until enough points carry the fit."""
    u = rng.standard_normal((300, 2)) + np.array([3.0, 0.0])
    u[0] = [1.0, 4.0]
    log_weights = np.zeros(300)
    log_weights[0] = 12.0
    (moved,) = refit_components([SubspaceGaussian(np.eye(2), np.array([3.0, 0.0]), np.ones(2))], u, log_weights)
    assert np.linalg.norm(moved.centre - [3.0, 0.0]) < 1.5
    assert moved.variance.min() > 0.5


@given(st.lists(st.floats(-50, 50), min_size=1, max_size=60))
def test_clipped_weights(log_weights):
    w = truncate_weights(np.array(log_weights))
    assert w.sum() == pytest.approx(1.0)
    assert w.min() >= 0
    order = np.argsort(log_weights)
    assert (np.diff(w[order]) >= -1e-15).all()
    even = truncate_weights(np.zeros(len(log_weights)))
    np.testing.assert_allclose(even, 1 / len(log_weights))


def test_clipping_is_at_the_root_of_n_times_the_mean():
    w = truncate_weights(np.append(np.zeros(99), 20.0))
    # the heavy one, nearly 1, is cut to 1 / 10; the others together are e^-20 x 99
    assert w[-1] == pytest.approx(0.1 / (0.1 + 99 * math.exp(-20)), rel=1e-6)
