import time

import numpy as np
import pytest
from scipy import optimize, stats
from scipy.special import betaln

from samplers.methods.blocks import beta_statistics, project_beta, project_mean

BOX = (1.5, 7.0)


def generic_beta(statistics, low, high):
    """The same problem by a quasi-Newton solver with bounds, from three starts."""
    runs = [
        optimize.minimize(
            lambda t: betaln(*t) - t @ statistics,
            start,
            jac=lambda t: beta_statistics(*t) - statistics,
            method="L-BFGS-B",
            bounds=[(low, high)] * 2,
            options={"ftol": 1e-15, "gtol": 1e-11, "maxiter": 1000},
        )
        for start in ([2.0, 2.0], [low, high], [high, low])
    ]
    return min(runs, key=lambda run: run.fun)


def test_beta_statistics_against_scipy():
    alpha, beta = np.array([1.5, 2.0, 7.0]), np.array([3.0, 2.0, 1.5])
    expected = [
        [stats.beta(a, b).expect(np.log), stats.beta(a, b).expect(lambda y: np.log1p(-y))]
        for a, b in zip(alpha, beta, strict=True)
    ]
    np.testing.assert_allclose(beta_statistics(alpha, beta), expected, rtol=1e-6)


def test_beta_projection_finds_the_distribution_itself(rng):
    alpha, beta = rng.uniform(1.5, 7.0, size=(2, 200))
    found = project_beta(beta_statistics(alpha, beta), *BOX)
    np.testing.assert_allclose(found, np.stack([alpha, beta], axis=1), rtol=1e-6)


def test_beta_projection_against_a_generic_solver(rng):
    """Statistics of distributions in and far out of the box: optima inside, on the four edges, in the four corners."""
    alpha, beta = np.exp(rng.uniform(np.log(0.2), np.log(60), size=(2, 300)))
    statistics = beta_statistics(alpha, beta)
    # a few points instead of a distribution: both statistics high, as no Beta in the box has them
    few = rng.uniform(0.01, 0.99, size=(50, 3))
    statistics = np.concatenate([statistics, np.stack([np.log(few).mean(axis=1), np.log1p(-few).mean(axis=1)], 1)])
    found = project_beta(statistics, *BOX)
    assert ((found >= BOX[0]) & (found <= BOX[1])).all()
    for own, row in zip(found, statistics, strict=True):
        generic = generic_beta(row, *BOX)
        value = betaln(*own) - own @ row
        assert value <= generic.fun + 1e-10 * abs(generic.fun)
        np.testing.assert_allclose(own, generic.x, atol=2e-4)
    at_low, at_high = found == BOX[0], found == BOX[1]
    kinds = {tuple(kind) for kind in (np.where(at_low, -1, 0) + np.where(at_high, 1, 0)).tolist()}
    assert len(kinds) == 9  # inside, four edges, four corners


@pytest.mark.parametrize("box", [(0.5, 5.0), (0.01, 1000.0), (2.0, 2.5)])
def test_beta_projection_meets_the_optimality_conditions(rng, box):
    y = rng.beta(*np.exp(rng.normal(size=(2, 100, 1))), size=(100, 30)).clip(1e-12, 1 - 1e-12)
    statistics = np.stack([np.log(y).mean(axis=1), np.log1p(-y).mean(axis=1)], axis=1)
    theta = project_beta(statistics, *box)
    slope = statistics - beta_statistics(theta[:, 0], theta[:, 1])
    assert (slope[theta > box[0]] >= -1e-9).all()
    assert (slope[theta < box[1]] <= 1e-9).all()


def correlated(dim, rng, scale=0.05):
    factors = rng.standard_normal((dim, dim // 4 + 1))
    covariance = scale**2 * (factors @ factors.T / factors.shape[1] + 0.2 * np.eye(dim))
    return np.linalg.cholesky(covariance)


def distance(mean, target, cholesky):
    """Kullback-Leibler divergence from N(target, S) to N(mean, S)."""
    return 0.5 * np.sum(np.linalg.solve(cholesky, mean - target) ** 2)


@pytest.mark.parametrize("scale", [1e-3, 0.05, 100.0])
def test_mean_projection_against_a_generic_solver(rng, scale):
    """The answer of bounded least squares; clipping each coordinate is worse."""
    for dim in (2, 5, 30):
        cholesky, centre = correlated(dim, rng, scale), scale * rng.standard_normal(dim)
        target, radius = centre + scale * rng.standard_normal(dim), 0.5 * scale
        inverse = np.linalg.inv(cholesky)
        generic = optimize.lsq_linear(inverse, inverse @ (target - centre), (-radius, radius), tol=1e-14).x + centre
        found = project_mean(target, centre, cholesky, radius)
        assert np.abs(found - centre).max() <= radius * (1 + 1e-12)
        np.testing.assert_allclose(found, generic, atol=1e-5 * scale)
    clipped = np.clip(target, centre - radius, centre + radius)
    assert distance(found, target, cholesky) < 0.99 * distance(clipped, target, cholesky)


def test_mean_projection_needs_no_solver_where_the_answer_is_known(rng, monkeypatch):
    monkeypatch.setattr("samplers.methods.blocks._box_least_squares", None)
    cholesky, target = correlated(6, rng), 0.01 * rng.standard_normal(6)
    np.testing.assert_array_equal(project_mean(target, np.zeros(6), cholesky, 1.0), target)
    np.testing.assert_array_equal(project_mean(target, np.zeros(6), cholesky, np.inf), target)
    diagonal = np.diag(rng.uniform(1, 2, 6))
    np.testing.assert_array_equal(project_mean(target, np.zeros(6), diagonal, 0.005), np.clip(target, -0.005, 0.005))
    np.testing.assert_array_equal(project_mean(target, np.ones(6), cholesky, 0.0), np.ones(6))


def test_mean_projection_of_404_weights_is_fast(rng):
    cholesky = correlated(404, rng)
    target = 0.02 * rng.standard_normal(404)
    project_mean(target, np.zeros(404), cholesky, 0.01)  # imports the solver
    start = time.perf_counter()
    found = project_mean(target, np.zeros(404), cholesky, 0.01)
    assert time.perf_counter() - start < 5.0  # 0.1 s as a rule
    slope = np.linalg.solve(cholesky @ cholesky.T, target - found)
    free = np.abs(found) < 0.01 * (1 - 1e-9)
    assert 0 < free.sum() < 404
    assert np.abs(slope[free]).max() < 1e-6 * np.abs(slope).max()
    assert (slope[~free] * found[~free] >= 0).all()
