"""The search by terms on series systems with exact p, and what it does where terms or gradients are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm

import samplers
from samplers.execution.arguments import InputsOnly
from samplers.method import Goal, TermsOffer
from samplers.methods.two_stage.method import run_two_stage
from samplers.methods.two_stage.settings import DEFAULT_SETTINGS
from samplers.methods.two_stage.terms.search import suits_terms
from samplers.problem import TermGradients, Terms
from samplers.trace import Status

SETTINGS = DEFAULT_SETTINGS.terms


def runs(problem, seeds, **options):
    options = {"max_sim": 6000, **options}
    return [samplers.estimate(problem, seed=seed, **options) for seed in seeds]


def check(results, p, own_low=0.5):
    """Mean within 4 of its standard errors by the runs' own c.o.v.; most intervals hold p; the own c.o.v. is no lie."""
    ratios, covs = np.array([r.p for r in results]) / p, np.array([r.cov for r in results])
    assert abs(ratios.mean() - 1) < 4 * np.sqrt((covs**2).mean() / len(results))
    held = sum(r.interval[0] <= p <= r.interval[1] for r in results)
    assert held >= len(results) - 1 - len(results) // 10
    spread = np.sqrt(((ratios - 1) ** 2).mean())  # chi^2 with len(results) degrees of freedom, by 1 in 1,000
    assert covs.mean() > own_low * spread / np.sqrt(chi2.isf(1e-3, len(results)) / len(results))


def test_the_rule_is_terms_gradients_dimension_and_budget(half_spaces):
    problem = half_spaces(400, 1e-4)[0]
    full = TermsOffer(3.0)
    assert suits_terms(problem, full, 6000, SETTINGS)
    assert not suits_terms(problem, None, 6000, SETTINGS)
    assert not suits_terms(problem, TermsOffer(), 6000, SETTINGS)
    assert not suits_terms(problem, full, SETTINGS.min_budget - 1, SETTINGS)
    assert not suits_terms(half_spaces(SETTINGS.min_dim - 1, 1e-4)[0], full, 6000, SETTINGS)


@pytest.mark.parametrize(("dim", "p"), [(400, 1e-3), (400, 1e-8), (1448, 1e-5)])
def test_series_systems_of_half_spaces(half_spaces, dim, p):
    """Shares 0.8, 0.15 and 0.05. C.o.v. of 0.017 to 0.037 were measured."""
    problem, exact, _ = half_spaces(dim, p)
    results = runs(problem, range(10))
    check(results, exact)
    assert all(r.cov < 0.04 and r.n_sim <= 6000 and r.status is Status.CONVERGED for r in results)
    assert all(sum(level.n_sim for level in r.trace) == r.n_sim for r in results)
    assert not any(r.warnings for r in results)


def test_a_term_that_is_never_near_among_the_base_draws(half_spaces):
    """The second term is ten times as steep: far from its plane it is never the least. It is half of p."""
    problem, exact, _ = half_spaces(400, 1e-4, shares=(0.5, 0.5), scale=(1.0, 10.0))
    u = np.random.default_rng(0).standard_normal((600, 400))
    assert (problem.terms(u).least == 0).mean() > 0.99
    check(runs(problem, range(3)), exact)


class EarlyAndLate:
    """One car, two ways to hit it: early along one axis, late along another, told apart by the tick alone."""

    dim, base, gradient_cost = 300, samplers.StandardNormal(300), 2.0
    beta = np.array([3.7, 3.9])

    def terms(self, x, gamma=0.0):
        both = self.beta - x[:, :2]
        f = both.min(axis=1)
        return Terms(f, f[:, None], np.where(both.argmin(axis=1), 80, 20)[:, None], gamma)

    def evaluate(self, x):
        return self.terms(x).f

    def gradient(self, x, term, ticks, gamma=0.0):
        values = np.zeros(x.shape)
        values[np.arange(len(x)), (ticks == 80).astype(int)] = -1.0
        return TermGradients(values, cost=float((ticks / 40).sum()))


def test_a_term_with_an_early_and_a_late_mode():
    problem = EarlyAndLate()
    exact = 1 - np.prod(norm.cdf(problem.beta))
    results = runs(problem, range(3))
    check(results, exact)
    assert max(r.cov for r in results) < 0.06


def curved(dim=400):
    """One term bent towards the origin, one away from it; exact p by the distribution of the bends."""
    axes = np.linalg.qr(np.random.default_rng(1).standard_normal((dim, 12)))[0]

    def terms(x):
        z = x @ axes
        near = 3.6 - z[:, 0] + 0.15 * ((z[:, 2:6] ** 2).sum(axis=1) - 4)
        return np.column_stack([near, 4.0 - z[:, 1] - 0.1 * ((z[:, 6:10] ** 2).sum(axis=1) - 4)])

    def gradient(x, term):
        z, g = x @ axes, np.zeros((len(x), 12))
        g[np.arange(len(x)), term] = -1.0
        g[term == 0, 2:6] = 0.3 * z[term == 0, 2:6]
        g[term == 1, 6:10] = -0.2 * z[term == 1, 6:10]
        return g @ axes.T

    s = chi2(4).ppf((np.arange(200_000) + 0.5) / 200_000)
    p = [norm.sf(3.6 + 0.15 * (s - 4)).mean(), norm.sf(4.0 - 0.1 * (s - 4)).mean()]
    return samplers.FunctionProblem(dim=dim, terms=terms, gradient=gradient), p[0] + p[1] - p[0] * p[1]


def test_curved_terms():
    problem, exact = curved()
    check(runs(problem, range(4)), exact)


def lobes(dim=300, cosine=0.3):
    """Three terms, each a least over three planes whose normals share a direction, as those of other ticks do.

    Planes of one term meet at corr = cosine^2, so that p is the sum of all but a millionth.
    """
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.standard_normal((dim, 12)))[0].T.reshape(3, 4, dim)
    normals = cosine * axes[:, :1] + np.sqrt(1 - cosine**2) * axes[:, 1:]
    beta = np.array([3.6, 3.9, 4.2])[:, None] + 0.35 * rng.standard_normal((3, 3))

    def values(x):
        return beta - np.einsum("id,jkd->ijk", x, normals)

    def gradient(x, term):
        return -normals[term, values(x)[np.arange(len(x)), term].argmin(axis=1)]

    terms = samplers.FunctionProblem(dim=dim, terms=lambda x: values(x).min(axis=2), gradient=gradient)
    return terms, float(norm.sf(beta).sum())


def test_terms_with_several_modes():
    problem, exact = lobes()
    check(runs(problem, range(10, 14)), exact)


def test_a_wrong_gradient_costs_accuracy_and_nothing_else(half_spaces):
    """Gradients that are as much noise as signal: p stays right, the c.o.v. about doubles. With noise alone the search
    gives up, says so, and subset simulation has the rest."""
    rng = np.random.default_rng(5)
    _, exact, normals = half_spaces(400, 1e-4)
    half = half_spaces(400, 1e-4, gradient=lambda x, t: rng.standard_normal(x.shape) / 20 - normals[t])[0]
    check(runs(half, range(3)), exact)
    noise = half_spaces(400, 1e-4, gradient=lambda x, t: rng.standard_normal(x.shape) / 20)[0]
    results = runs(noise, range(3))
    assert all(any("subset simulation" in text for text in one.remarks) for one in results)
    check(results, exact)
    assert all(sum(level.n_sim for level in one.trace) == one.n_sim <= 6000 for one in results)


@pytest.mark.parametrize("known", [False, True])
def test_failures_of_a_term_that_nobody_pursued_are_told(half_spaces, known):
    """A term with 30 % of p has no gradient, so that nothing but base draws meets its failures; or it has one."""
    _, exact, normals = half_spaces(40, 0.03, shares=(0.7, 0.3))

    def gradient(x, term):
        return -normals[term] if known else np.where(term[:, None] == 0, -normals[term], np.nan)

    results = runs(half_spaces(40, 0.03, shares=(0.7, 0.3), gradient=gradient)[0], range(4), max_sim=20_000)
    check(results, exact)
    told = [any("terms without a proposal of their own" in text for text in one.warnings) for one in results]
    given_up = [any("subset simulation" in text for text in one.remarks) for one in results]
    if known:
        assert not any(told) and not any(given_up)
    else:
        assert any(told) and all(np.logical_or(told, given_up))


def test_gradients_that_raise_cost_accuracy_and_nothing_else(half_spaces):
    """On one point in four the gradient raises; with on_error="raise" the run ends there."""

    def raises(x, term):
        if (x[:, -1] > 0.7).any():
            raise ArithmeticError("no derivative")
        return -normals[term]

    _, exact, normals = half_spaces(100, 1e-4)
    problem = half_spaces(100, 1e-4, gradient=raises)[0]
    check(runs(problem, range(3), on_error="failure"), exact)
    with pytest.raises(samplers.EvaluationError, match="The gradient raised for row"):
        samplers.estimate(problem, seed=0, max_sim=6000)


def test_points_without_an_outcome_fail_and_are_left_to_subset_simulation(half_spaces):
    """x_0 > 2 gives NaN: a region of 0.023 that no term announces; no proposal of a term describes it."""
    inner, exact, _ = half_spaces(60, 1e-4)
    problem = samplers.FunctionProblem(
        dim=60,
        terms=lambda x: np.where(x[:, :1] > 2.0, np.nan, inner.terms(x).values),
        gradient=inner.gradient.function,
    )
    result = samplers.estimate(problem, seed=1, max_sim=6000, on_error="failure")
    assert result.interval[0] <= exact + norm.sf(2.0) <= result.interval[1]
    assert any("No proposal describes" in text for text in result.remarks)
    assert any("gave no outcome" in text for text in result.warnings)


def test_common_failures_are_left_to_monte_carlo(half_spaces):
    problem, exact, _ = half_spaces(50, 0.3)
    result = samplers.estimate(problem, seed=1, max_sim=4000)
    assert abs(result.p - exact) < 4 * np.sqrt(exact * (1 - exact) / 3600)
    assert result.n_sim == 4000


def test_without_any_failure_p_is_0_with_an_upper_end(half_spaces):
    problem, _, _ = half_spaces(50, 1e-4, shares=(1.0,))
    safe = samplers.FunctionProblem(dim=50, terms=lambda x: 9.0 + x[:, :1] ** 2, gradient=problem.gradient.function)
    result = samplers.estimate(safe, seed=1, max_sim=3000)
    assert result.p == 0 < result.interval[1] < 0.05
    assert result.status is Status.NO_HITS
    assert result.warnings


@pytest.mark.parametrize("max_sim", [1000, 1500, 2000, 20_000])
def test_budgets_are_kept_and_used(half_spaces, max_sim):
    problem, exact, _ = half_spaces(100, 1e-4)
    result = samplers.estimate(problem, seed=2, max_sim=max_sim)
    assert 0.9 * max_sim <= result.n_sim <= max_sim
    assert abs(result.p / exact - 1) < 4 * result.cov
    assert result.interval[0] < result.p < result.interval[1]


def test_a_target_is_met_with_few_simulations_or_many(half_spaces):
    problem, exact, _ = half_spaces(100, 1e-4)
    coarse, fine = (samplers.estimate(problem, seed=2, target_cov=target) for target in (0.1, 0.012))
    assert coarse.cov <= 0.1 and coarse.n_sim < 4500
    assert fine.cov <= 0.012 and fine.n_sim > 6000
    assert abs(fine.p / exact - 1) < 4 * fine.cov


def test_a_run_that_is_stopped_anywhere_has_an_outcome(half_spaces):
    problem, exact, _ = half_spaces(60, 1e-3)
    for at in (200, 800, 1500, 2000):
        result = samplers.estimate(problem, seed=2, max_sim=3000, stop=lambda seen, at=at: seen.n_sim >= at)
        assert result.status is Status.STOPPED
        assert sum(level.n_sim for level in result.trace) == result.n_sim
        assert result.interval[0] <= exact <= result.interval[1]


def test_common_failures_can_be_stopped_and_end_at_a_target(half_spaces):
    problem, exact, _ = half_spaces(40, 0.3)
    stopped = samplers.estimate(problem, samplers.TwoStage(n=1000), seed=1, stop=lambda seen: True)
    assert stopped.status is Status.STOPPED
    assert stopped.n_sim == 100
    assert stopped.interval[0] <= exact <= stopped.interval[1]
    met = samplers.estimate(problem, samplers.TwoStage(n=1000), seed=1, target_cov=0.1)
    assert met.cov <= 0.1
    assert met.n_sim == 100 + 500  # base draws that decided on it, and one batch


def test_replicates_share_the_budget_and_equal_runs_with_their_seeds(half_spaces):
    problem, exact, _ = half_spaces(60, 1e-3)
    result = samplers.estimate(problem, seed=2, max_sim=6000, replicates=3)
    assert result.n_sim <= 6000
    assert result.interval[0] <= exact <= result.interval[1]
    assert result == samplers.estimate(problem, seed=2, max_sim=6000, replicates=3)


@pytest.mark.parametrize("fraction", [0.5, 1.0])
def test_simulations_made_by_the_user_are_searched_as_before(half_spaces, fraction):
    """`start` offers no terms; the run asks for points only and ends with an estimate."""
    problem, _, _ = half_spaces(40, 1e-2)
    run = samplers.TwoStage().start(problem, seed=1, max_sim=int(3000 * fraction))
    while not run.done:
        run.tell(problem.evaluate(run.ask()))
    assert run.result() == samplers.estimate(
        samplers.FunctionProblem(problem.evaluate, dim=40), seed=1, max_sim=int(3000 * fraction)
    )


def test_a_search_takes_its_numbers_from_the_settings_given(half_spaces, answer):
    """Other base draws are another first level; a smallest budget above that of the run is for the other search."""
    problem, _, _ = half_spaces(40, 1e-3)
    inputs = InputsOnly(problem.dim, problem.base, TermsOffer(problem.gradient_cost))

    def first_level(terms):
        settings = replace(DEFAULT_SETTINGS, terms=terms)
        steps = run_two_stage(inputs, Goal(gamma=0.0, max_sim=2000), 2000, np.random.default_rng(0), settings)
        return answer(steps, problem).trace[0].n_sim

    assert first_level(SETTINGS) == 200
    assert first_level(replace(SETTINGS, rounds=replace(SETTINGS.rounds, base=0.2))) == 400
    assert first_level(replace(SETTINGS, min_budget=5000)) not in (200, 400)


@pytest.mark.parametrize(
    ("dim", "p", "options"),
    [
        (60, 1e-3, {}),  # the final rounds
        (60, 1e-3, {"replicates": 2}),
        (40, 0.3, {}),  # Monte Carlo after base draws that do not count
        (60, 1e-3, {"stop": lambda seen: seen.n_sim >= 1500}),  # all draws so far
        (60, 1e-3, {"stop": lambda seen: seen.n_sim >= 150}),  # base draws
    ],
)
def test_p_is_the_sum_of_the_weights_of_single_simulations(half_spaces, dim, p, options):
    """Gradients cost simulations and are none, so that there are fewer of them than `n_sim`."""
    problem, _, _ = half_spaces(dim, p)
    result = samplers.estimate(problem, seed=2, max_sim=3000, keep_points=True, **options)
    rows = result.simulations.describe(0, len(result.points.f))
    known = ~np.isnan(rows.log_weight)
    weights = np.exp(rows.log_weight[known])
    assert weights[result.points.f[known] <= 0].sum() == pytest.approx(result.p, rel=1e-12)
    assert abs(weights.sum() - 1) <= 5 * weights.std() * len(weights) ** 0.5 + 1e-9  # as in any weighted sample
