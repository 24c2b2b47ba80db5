"""Cross-entropy: search, families, weights of the final draws, warnings."""

import math

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.importance import Draws, defensive_mixture, simulate_until, weight_warnings, weighted_interval
from samplers.limit_states import four_branches, half_space, parabola, plateau, two_modes
from samplers.method import Goal
from samplers.methods.blocks import GaussianBlock, MixtureBlock, Product
from samplers.proposals import Gaussian

CE = samplers.CrossEntropy


def mean_error(found):
    return found.ratios.std(ddof=1) / math.sqrt(len(found.results))


def test_search_goes_down_to_gamma_and_is_counted():
    result = samplers.estimate(half_space().problem, CE(), seed=1)
    levels = [level.gamma for level in result.trace]
    assert levels == sorted(levels, reverse=True)
    assert levels[-1] == 0.0
    assert result.n_sim == sum(level.n_sim for level in result.trace)
    assert result.trace[-1].n_sim == 4000
    assert result.p == result.trace[-1].estimate  # the fresh draws alone


@pytest.mark.slow
@pytest.mark.parametrize("tied", [0.6, 0.85, 0.95])
def test_ties_at_a_cap(study, tied):
    found = study(plateau(3, 3.2, tied), CE(), 60)
    assert abs(found.ratios.mean() - 1) < 4 * mean_error(found) + 0.01
    assert found.covered >= stats.binom.ppf(1e-3, 60, 0.90)
    assert {str(result.status) for result in found.results} == {"converged"}


@pytest.mark.parametrize(
    "reference",
    [
        two_modes(),
        pytest.param(four_branches(3.0), marks=pytest.mark.slow),
        pytest.param(parabola(), marks=pytest.mark.slow),
    ],
    ids=lambda r: r.name,
)
def test_mixture_family(study, reference):
    found = study(reference, CE(family="mixture"), 40)
    assert abs(found.ratios.mean() - 1) < 4 * mean_error(found) + 0.02
    assert found.covered >= stats.binom.ppf(1e-3, 40, 0.90)
    assert found.own_cov < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("family", ["gaussian", "mean", "mixture"])
@pytest.mark.parametrize("reference", [half_space(), half_space(6), parabola(), plateau()], ids=lambda r: r.name)
def test_one_region_is_covered_at_the_usual_settings(study, reference, family):
    found = study(reference, CE(family=family), 200)
    assert abs(found.ratios.mean() - 1) < 4 * mean_error(found) + 0.01
    assert found.covered >= 0.88 * 200
    assert 0.8 < found.own_cov / found.ratios.std(ddof=1) < 1.3


@pytest.mark.parametrize("family", ["gaussian", "mean", "mixture"])
def test_a_run_stopped_in_the_search_gives_what_there_is(family):
    """After each batch in turn; all of it within its own error of p, or wide."""
    reference = half_space(2, 3.0)
    for after in range(1, 6):
        run = CE(family=family, n_final=1000).start(reference.problem, seed=3, target_cov=0.01)
        for _ in range(after):
            run.tell(reference.problem.f(run.ask()))
        result = run.result()
        assert result.status == "stopped"
        assert result.n_sim == sum(level.n_sim for level in result.trace) == 1000 * after
        assert result.interval[0] / 1.2 <= reference.p <= 1.2 * result.interval[1]
        assert result.warnings if after < 4 else 0 < result.cov < 0.2


def test_final_draws_serve_higher_thresholds():
    """P[u >= beta - g] of all g from the weights of all final draws."""
    sample = samplers.estimate(half_space(2, 3.5).problem, CE(), seed=1).sample
    assert sample.n_units == len(sample.f) == 4000
    for g in (0.0, 0.5, 1.0, 2.0, 3.5):
        weights = sample.weights[sample.f <= g]
        assert weights.sum() == pytest.approx(stats.norm.sf(3.5 - g), abs=4 * np.sqrt((weights**2).sum()))
    np.testing.assert_allclose(half_space(2, 3.5).problem.f(sample.x), sample.f[sample.f <= 0])


def test_a_step_of_the_search_matches_moments():
    """Equation 2 for a Gaussian: with alpha = 1 and many points the moments of the elite."""
    elite = np.random.default_rng(1).standard_normal((100_000, 2)) * [0.5, 1.0] + [2.0, 0.0]
    start, ratios = Product((GaussianBlock(Gaussian.standard(2)),)), np.zeros((1, len(elite)))
    moved = CE()._project(start, elite, ratios, 1.0).blocks[0].gaussian
    np.testing.assert_allclose(moved.mean, elite.mean(axis=0))
    np.testing.assert_allclose(moved.covariance, np.cov(elite.T), atol=1e-3)
    half = CE()._project(start, elite, ratios, 0.5).blocks[0].gaussian
    np.testing.assert_allclose(half.mean, elite.mean(axis=0) / 2)
    # mixture of N(0, I) and the elite: mean of the variances plus a quarter of the shift squared
    np.testing.assert_allclose(np.diag(half.covariance), [0.625 + 1.0, 1.0], atol=0.02)


def test_a_step_of_the_search_uses_the_likelihood_ratio(rng):
    """From N((1.5, 0), I) the step aims at N(0, I) given u1 > 2: mean phi(2) / Phi(-2) = 2.373.

    Without the weights it would be 1.5 + phi(0.5) / Phi(-0.5) = 2.641.
    """
    proposal = Gaussian(np.array([1.5, 0.0]), np.eye(2))
    u = proposal.sample(200_000, rng)
    u = u[u[:, 0] > 2.0]
    log_ratios = (Gaussian.standard(2).log_prob(u) - proposal.log_prob(u))[None]
    moved = CE()._project(Product((GaussianBlock(proposal),)), u, log_ratios, 1.0)
    np.testing.assert_allclose(moved.blocks[0].gaussian.mean, [stats.norm.pdf(2) / stats.norm.sf(2), 0.0], atol=0.02)


def test_target_cov_is_met_by_more_final_draws():
    loose = samplers.estimate(half_space().problem, CE(), seed=1)
    tight = samplers.estimate(half_space().problem, CE(), seed=1, target_cov=0.01)
    assert loose.cov > 0.01 >= tight.cov
    assert tight.status == "converged"
    assert tight.n_sim > loose.n_sim


def test_weights_of_the_final_draws_give_p(drive, rng):
    reference, far = half_space(2, 3.0), Gaussian(np.full(2, 2.2), np.eye(2))
    base = Product((GaussianBlock(Gaussian.standard(2)),))
    proposal = Product((GaussianBlock(far),))
    sampler = defensive_mixture(base, proposal.widen(1.5), proposal, 0.1, 0.2)
    draws = drive(
        simulate_until(reference.problem, sampler, Goal(gamma=0.0), 50_000, 50_000, rng), reference.problem
    ).value[0]
    assert draws.p == pytest.approx(reference.p, rel=4 * draws.cov)
    assert np.exp(draws.log_weights).max() <= 10.0
    assert draws.cov < 0.02


def test_warns_when_few_draws_carry_the_estimate():
    heavy = Draws(1000, np.zeros(3), np.array([0.0, 0.0, 3.0]))
    assert len(weight_warnings(heavy)) == 2
    assert weight_warnings(Draws(1000, np.zeros(500), np.zeros(500))) == []
    light = weighted_interval(Draws(1000, np.zeros(500), np.full(500, -5.0)), 0.95, 10.0)
    assert light[1] / light[0] < 1.3
    wide = weighted_interval(heavy, 0.95, 10.0)
    assert wide[1] / wide[0] > 10


@pytest.mark.slow
def test_interval_of_a_hopeless_proposal_still_holds_p():
    """d = 300: the weights degenerate, p-hat is far too small, and the result does not hide it."""
    reference = half_space(300)
    for seed in range(4):
        result = samplers.estimate(reference.problem, CE(), seed=seed, max_sim=4000)
        assert result.interval[0] <= reference.p <= result.interval[1]
        assert result.warnings


@pytest.mark.parametrize(
    "settings",
    [
        {"rho": 0.6},
        {"alpha": 0.0},
        {"alpha": 1.2},
        {"n_iteration": 1},
        {"n_final": 0},
        {"max_iterations": 0},
        {"base_share": 0.0},
        {"wide_share": 0.95},
        {"wide_factor": 0.5},
        {"family": "beta"},
        {"likelihood_ratio": "none"},
        {"choice": "last"},
        {"components": 0},
        {"alpha": (0.8, 1.2)},
        {"alpha": ()},
        {"n_iteration": (1000, 5)},
    ],
)
def test_settings_out_of_range(settings):
    with pytest.raises(ValueError, match=f"CrossEntropy: expected .*{next(iter(settings))}"):
        CE(**settings)


def uniform_weights(n):
    return np.full(n, 1 / n)


def test_mixture_splits_into_two_regions(rng):
    """Two clusters and a step alpha = 1: one component each, with the share and the mean of its cluster."""
    elite = rng.standard_normal((4000, 2)) * 0.3 + np.where(rng.random((4000, 1)) < 0.25, [3.0, 0.0], [-3.0, 1.0])
    moved = MixtureBlock(Gaussian.standard(2), 2).project(elite, uniform_weights(4000), 1.0)
    order = np.argsort(moved.mixture.weights)
    np.testing.assert_allclose(moved.mixture.weights[order], [0.25, 0.75], atol=0.03)
    means = np.array([moved.mixture.components[j].mean for j in order])
    np.testing.assert_allclose(means, [[3.0, 0.0], [-3.0, 1.0]], atol=0.05)
    np.testing.assert_allclose(moved.mixture.components[0].covariance, 0.09 * np.eye(2), atol=0.02)


def test_mixture_steps_raise_the_objective_of_equation_2(rng):
    """alpha E_Q[log p] + (1 - alpha) E_P[log p], by draws; no pull worth mentioning at 20,000 points."""
    elite = rng.standard_normal((20_000, 2)) + np.where(rng.random((20_000, 1)) < 0.3, [3.0, 0.0], [0.0, 3.0])
    block = MixtureBlock(Gaussian.standard(2), 3).project(elite, uniform_weights(20_000), 0.5)
    other = elite * [1.0, 0.6]
    values = []
    draws = block.sample(20_000, rng)
    for distribution in (block, block.project(other, uniform_weights(20_000), 0.7)):
        values.append(0.7 * distribution.log_prob(other).mean() + 0.3 * distribution.log_prob(draws).mean())
    assert values[1] > values[0] + 0.01


def test_mixture_keeps_the_share_1_minus_alpha_of_the_present_distribution():
    """All of Q in one point: with alpha = 0.8 the mean of the new mixture is 0.8 of the way there."""
    elite = np.tile([2.0, 1.0], (50, 1))
    block = MixtureBlock(Gaussian.standard(2), 3).project(elite, uniform_weights(50), 0.8)
    mean = sum(w * c.mean for w, c in zip(block.mixture.weights, block.mixture.components, strict=True))
    np.testing.assert_allclose(mean, [1.6, 0.8])
    x = np.random.default_rng(1).standard_normal((100, 2))
    start = MixtureBlock(Gaussian.standard(2), 3)
    np.testing.assert_allclose(start.log_prob(x), Gaussian.standard(2).log_prob(x))
