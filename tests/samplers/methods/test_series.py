"""Series on series systems with exact p, and what it does where terms or gradients are wrong."""

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad
from scipy.stats import chi2, norm

import samplers
from samplers.problem import TermGradients, Terms
from samplers.sample import Status


def half_spaces(dim, p, shares=(0.8, 0.15, 0.05), scale=None, seed=0, **options):
    """Return a problem that fails beyond any of some orthogonal planes, its exact p and the normals (J, d)."""
    normals = np.linalg.qr(np.random.default_rng(seed).standard_normal((dim, len(shares))))[0].T
    beta, scale = -norm.ppf(np.array(shares) * p), np.ones(len(shares)) if scale is None else np.array(scale)

    def gradient(x, term):
        return -normals[term] * scale[term][:, None]

    options = {"gradient": gradient, **options}
    problem = samplers.FunctionProblem(dim=dim, terms=lambda x: (beta - x @ normals.T) * scale, **options)
    return problem, float(1 - np.prod(norm.cdf(beta))), normals


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


@pytest.mark.parametrize(
    ("dim", "p", "seeds"),
    [
        (400, 1e-3, 2),
        pytest.param(400, 1e-8, 10, marks=pytest.mark.slow),
        pytest.param(1448, 1e-5, 10, marks=pytest.mark.slow),
    ],
)
def test_series_systems_of_half_spaces(dim, p, seeds):
    """Shares 0.8, 0.15 and 0.05. C.o.v. of 0.017 to 0.037 were measured."""
    problem, exact, _ = half_spaces(dim, p)
    results = runs(problem, range(seeds))
    check(results, exact)
    assert all(r.cov < 0.04 and r.n_sim <= 6000 and r.status is Status.CONVERGED for r in results)
    assert all(sum(level.n_sim for level in r.trace) == r.n_sim for r in results)
    assert not any(r.warnings for r in results)


class EarlyAndLate:
    """One car, two ways to hit it: early along one axis, late along another, told apart by the tick alone."""

    dim, base, gradient_cost = 300, samplers.distributions.StandardNormal(300), 2.0
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


def test_curved_terms():
    """Terms b - u_1 + c u_2^2 in directions of their own: one that bends away from the origin, one towards it."""
    axes = np.linalg.qr(np.random.default_rng(1).standard_normal((100, 4)))[0].T
    b, c = np.array([3.2, 4.0]), np.array([0.2, -0.05])

    def gradient(x, term):
        return -axes[term] + 2 * c[term, None] * (x * axes[2 + term]).sum(axis=1, keepdims=True) * axes[2 + term]

    problem = samplers.FunctionProblem(
        dim=100, terms=lambda x: b - x @ axes[:2].T + c * (x @ axes[2:].T) ** 2, gradient=gradient
    )
    shares = [quad(lambda t, j=j: norm.sf(b[j] + c[j] * t * t) * norm.pdf(t), -12, 12)[0] for j in (0, 1)]
    results = runs(problem, range(3), max_sim=4000)
    check(results, 1 - np.prod(1 - np.array(shares)))
    assert max(r.cov for r in results) < 0.08


CORRELATED = 0.5 * np.eye(30) + 0.5


@pytest.mark.parametrize(
    ("base", "least", "exact"),
    [
        (stats.expon(scale=np.ones(30)), 8.0, 1 - (1 - np.exp(-8.0)) ** 2),
        (
            stats.multivariate_normal(np.zeros(30), CORRELATED),
            3.5,
            1 - stats.multivariate_normal(np.zeros(2), CORRELATED[:2, :2]).cdf([3.5, 3.5]),
        ),
    ],
    ids=["independent", "correlated"],
)
def test_gradients_are_carried_through_the_map_of_the_base(base, least, exact):
    """Failure beyond a value of the first variable or of the last one; the map is known by its values alone."""

    def gradient(x, term):
        return -np.eye(30)[np.where(term == 0, 0, 29)]

    problem = samplers.FunctionProblem(base=base, terms=lambda x: least - x[:, [0, 29]], gradient=gradient)
    results = runs(problem, range(2), max_sim=2000)
    check(results, exact)
    assert max(r.cov for r in results) < 0.08


@pytest.mark.slow
def test_a_wrong_gradient_costs_accuracy_and_nothing_else():
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


@pytest.mark.slow
@pytest.mark.parametrize("known", [False, True])
def test_failures_of_a_term_that_nobody_pursued_are_told(known):
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


def test_common_failures_are_left_to_monte_carlo():
    problem, exact, _ = half_spaces(50, 0.3)
    result = samplers.estimate(problem, seed=1, max_sim=4000)
    assert abs(result.p - exact) < 4 * np.sqrt(exact * (1 - exact) / 3600)
    assert result.n_sim == 4000


def test_without_any_failure_p_is_0_with_an_upper_end():
    _, _, normals = half_spaces(50, 1e-4, shares=(1.0,))
    options = {"terms": lambda x: 9.0 + x[:, :1] ** 2, "gradient": lambda x, term: -normals[term]}
    safe = samplers.FunctionProblem(dim=50, **options)
    result = samplers.estimate(safe, seed=1, max_sim=3000)
    assert result.p == 0 < result.interval[1] < 0.05
    assert result.status is Status.NO_HITS
    assert result.warnings


@pytest.mark.parametrize("max_sim", [1000, 2000])
def test_budgets_are_kept_and_used(max_sim):
    problem, exact, _ = half_spaces(100, 1e-4)
    result = samplers.estimate(problem, seed=2, max_sim=max_sim)
    assert 0.9 * max_sim <= result.n_sim <= max_sim
    assert abs(result.p / exact - 1) < 4 * result.cov
    assert result.interval[0] < result.p < result.interval[1]


@pytest.mark.slow
def test_a_target_is_met_with_few_simulations_or_many():
    problem, exact, _ = half_spaces(100, 1e-4)
    coarse, fine = (samplers.estimate(problem, seed=2, target_cov=target) for target in (0.1, 0.012))
    assert coarse.cov <= 0.1 and coarse.n_sim < 4500
    assert fine.cov <= 0.012 and fine.n_sim > 6000
    assert abs(fine.p / exact - 1) < 4 * fine.cov


def test_a_run_that_is_stopped_anywhere_has_an_outcome():
    problem, exact, _ = half_spaces(60, 1e-3)
    for at in (200, 800, 1500, 2000):
        result = samplers.estimate(problem, seed=2, max_sim=3000, stop=lambda seen, at=at: seen.n_sim >= at)
        assert result.status is Status.STOPPED
        assert sum(level.n_sim for level in result.trace) == result.n_sim
        assert result.interval[0] <= exact <= result.interval[1]


def test_simulations_made_by_the_user_are_searched_as_before():
    """`start` offers no terms: `series` says so, another method asks for points only and ends with an estimate."""
    problem, _, _ = half_spaces(40, 1e-2)
    with pytest.raises(ValueError, match="Series needs `terms` and `gradient`"):
        samplers.Series().start(problem)
    run = samplers.TwoStage().start(problem, seed=1, max_sim=1500)
    while not run.done:
        run.tell(problem.evaluate(run.ask()))
    alone = samplers.FunctionProblem(problem.evaluate, dim=40)
    assert run.result() == samplers.estimate(alone, samplers.TwoStage(), seed=1, max_sim=1500)


@pytest.mark.parametrize(
    ("dim", "p", "options"),
    [
        (60, 1e-3, {}),  # the final rounds
        (60, 1e-3, {"replicates": 2}),
        (40, 0.3, {}),  # Monte Carlo after base draws that do not count
        (60, 1e-3, {"stop": lambda seen: seen.n_sim >= 150}),  # base draws
    ],
)
def test_p_is_the_sum_of_the_weights_of_single_simulations(dim, p, options):
    """Gradients cost simulations and are none, so that there are fewer of them than `n_sim`."""
    problem, _, _ = half_spaces(dim, p)
    result = samplers.estimate(problem, seed=2, max_sim=3000, keep_points=True, **options)
    rows = result.describe_simulations(0, len(result.points.f))
    known = ~np.isnan(rows.log_weight)
    weights = np.exp(rows.log_weight[known])
    assert weights[result.points.f[known] <= 0].sum() == pytest.approx(result.p, rel=1e-12)
    assert abs(weights.sum() - 1) <= 5 * weights.std() * len(weights) ** 0.5 + 1e-9  # as in any weighted sample
