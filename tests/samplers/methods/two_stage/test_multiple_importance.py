"""P[u > 2] in one dimension from draws of N(0, 1), N(2, 1) and N(0, 2^2)."""

import math

import numpy as np
import pytest
from scipy import stats

from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.simulator import ComponentDraws
from samplers.problem import FunctionProblem
from samplers.proposals.components import IsotropicNormal, SubspaceGaussian, draw_components

BETA = 2.0
P = stats.norm.sf(BETA)
PROBLEM = FunctionProblem(lambda u: BETA - u[:, 0], 1)
BASE, WIDE = IsotropicNormal(1), IsotropicNormal(1, 2.0)
SHIFTED = SubspaceGaussian(np.eye(1), np.array([2.0]), np.array([1.0]))


def draws(rng, components, counts):
    u = draw_components(components, np.array(counts), rng)
    return ComponentDraws(components, np.array(counts), u, PROBLEM.evaluate(u))


def sample_of(*batches):
    found = MultipleImportanceSample.empty(1)
    for batch in batches:
        found = found.add(batch, 0.0)
    return found


def two_batches(rng):
    return draws(rng, [BASE, WIDE], [40, 60]), draws(rng, [BASE, SHIFTED, WIDE], [10, 90, 0])


def test_weights_are_those_of_the_mixture_of_all_components(rng):
    """phi / (50 phi + 60 N(0, 4) + 90 N(2, 1)) at every failing draw."""
    found = sample_of(*two_batches(rng))
    u = found.u[:, 0]
    density = 50 * stats.norm.pdf(u) + 60 * stats.norm.pdf(u, 0, 2) + 90 * stats.norm.pdf(u, 2, 1)
    np.testing.assert_allclose(np.exp(found.log_weights), stats.norm.pdf(u) / density, rtol=1e-12)
    assert found.n == 200
    assert (u >= BETA).all()


def test_weights_do_not_depend_on_the_order_of_the_batches(rng):
    first, second = two_batches(rng)
    found, swapped = sample_of(first, second), sample_of(second, first)
    order, other = np.argsort(found.u[:, 0]), np.argsort(swapped.u[:, 0])
    np.testing.assert_allclose(found.log_weights[order], swapped.log_weights[other], rtol=1e-12)


def test_adding_draws_leaves_the_sample_as_it_was(rng):
    first, second = two_batches(rng)
    before = sample_of(first)
    weights, n = before.log_weights.copy(), before.n
    after = before.add(second, 0.0)
    np.testing.assert_array_equal(before.log_weights, weights)
    assert (before.n, after.n) == (n, n + 100)


def test_no_weight_exceeds_that_of_the_base_draws(rng):
    """A base draw stands for n / n_0 of itself at most, with n_0 = 50 of n = 200 draws from phi."""
    _, _, log_weights = sample_of(*two_batches(rng)).all_draws()
    assert len(log_weights) == 200
    assert np.exp(log_weights).max() <= 1 / 50 + 1e-12


def test_p_is_unbiased(rng):
    runs = 400
    p = np.array([np.exp(sample_of(*two_batches(rng)).log_weights).sum() for _ in range(runs)])
    assert p.mean() == pytest.approx(P, abs=4 * p.std() / math.sqrt(runs))
    assert p.std() < 0.2 * P  # plain Monte Carlo: sqrt((1 - p) / (200 p)) = 0.46


def test_as_draws_of_one_proposal_they_say_the_same(rng):
    found = sample_of(*two_batches(rng))
    together = found.to_draws(PROBLEM, 0.0)
    assert together.n == 200
    assert together.p == pytest.approx(np.exp(found.log_weights).sum(), rel=1e-12)
    np.testing.assert_array_equal(np.sort(together.x[:, 0]), np.sort(found.u[:, 0]))


def test_an_empty_sample_knows_nothing():
    empty = MultipleImportanceSample.empty(3)
    assert empty.n == 0
    assert empty.u.shape == (0, 3)
    assert empty.log_weights.shape == (0,)
