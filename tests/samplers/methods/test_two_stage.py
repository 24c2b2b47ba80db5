"""Two-stage: budget, any kind of f, runs that are stopped, coverage; what takes over where no proposal fits."""

import math

import numpy as np
import pytest
from scipy import stats

import samplers
from benchmarks.samplers.problems import PROBLEMS
from samplers.limit_states import Reference, four_branches, half_space, shell
from samplers.methods.two_stage.regions import Discovery
from samplers.problem import FunctionProblem

TS = samplers.TwoStage
PHI = stats.norm.cdf


def reference(name, f, dim, p):
    return Reference(name, FunctionProblem(f, dim), float(p))


def two_regions(dim, first=3.4, second=3.5):
    """Two orthogonal half-spaces; half of them is missed by whoever follows f downhill from one point."""
    p = 1 - PHI(first) * PHI(second)
    return reference(f"two_regions_d{dim}", lambda u: np.minimum(first - u[:, 0], second + u[:, 1]), dim, p)


def deceptive():
    """f falls gently towards a region of probability 3e-7 and steeply, close by, towards that of 2e-4."""
    p = PHI(-5.0) + PHI(-3.5)
    return reference("deceptive", lambda u: np.minimum(0.5 * (5 - u[:, 0]), 10 * (3.5 + u[:, 0])), 2, p)


def noisy(dim=6, noise=0.5):
    """f with noise of its own, a function of u that looks independent of it: p = Phi(-beta / sqrt(1 + noise^2))."""

    def f(u):
        share = 43758.5453 * np.sin(u @ np.linspace(9.1, 13.7, dim))
        rough = stats.norm.ppf(np.clip(share - np.floor(share), 1e-9, 1 - 1e-9))
        return 3.5 - u.sum(axis=1) / math.sqrt(dim) + noise * rough

    return reference(f"noisy_d{dim}", f, dim, PHI(-3.5 / math.sqrt(1 + noise**2)))


def counted(recorder, problem, method="two-stage", **options):
    """Return an estimate whose counts and interval are sane."""
    f = recorder(problem.f)
    result = samplers.estimate(FunctionProblem(f, problem.dim), method, **options)
    low, high = result.interval
    assert result.n_sim == f.rows == sum(level.n_sim for level in result.trace)
    assert 0 <= low <= result.p <= high <= 1
    assert high > 0 and result.cov >= 0
    return result


@pytest.mark.parametrize("max_sim", [7, 399, 1500])
def test_the_budget_is_used_up_and_not_exceeded(recorder, max_sim):
    assert counted(recorder, four_branches().problem, seed=1, max_sim=max_sim).n_sim == max_sim


@pytest.mark.slow
def test_no_budget_is_exceeded_whatever_the_regions(recorder):
    """It is used up too, but where subset simulation takes over and reaches the failures before its end."""
    cube = FunctionProblem(lambda u: 3.3 - np.abs(u).max(axis=1), 10)
    corners = FunctionProblem(lambda u: 1.6 - np.abs(u[:, :3]).min(axis=1), 5)
    problems = [cube, corners, *(r.problem for r in (four_branches(), shell(2), shell(40), two_regions(60), noisy()))]
    for problem in problems:
        for max_sim in (400, 410, 450, 500, 600, 800, 1000, 1300, 2000, 3000):
            for seed in range(3):
                result = counted(recorder, problem, seed=seed, max_sim=max_sim)
                assert result.n_sim <= max_sim
                taken_over = any("p is from adaptive subset simulation" in text for text in result.remarks)
                assert result.n_sim == max_sim or taken_over


def test_too_small_a_budget_is_plain_monte_carlo_and_says_so():
    result = samplers.estimate(half_space(2, 1.0).problem, TS(), seed=1, max_sim=300)
    assert result.p * 300 == pytest.approx(round(result.p * 300))
    assert any("too few for an exploration" in text for text in result.remarks)


def test_estimate_rests_on_the_draws_of_the_last_round_and_those_after_it_alone():
    """Its points are the last ones asked for; nothing of the exploration counts twice."""
    reference, asked = half_space(100, 3.5), []
    run = TS().start(reference.problem, seed=1)
    while not run.done:
        asked.append(run.ask())
        run.tell(reference.problem.f(asked[-1]))
    last = np.concatenate(asked[-2:])
    result = run.result()
    failing = last[reference.problem.f(last) <= 0]
    np.testing.assert_array_equal(result.sample.x, failing)
    assert [level.n_sim for level in result.trace[-2:]] == [len(x) for x in asked[-2:]]


def case(name):
    """A problem of the benchmark."""
    state = PROBLEMS[name].make()
    return Reference(name, state.problem(), state.p)


@pytest.mark.parametrize("known", [case("two_d10"), case("corner_d5"), half_space(700)], ids=["two", "corner", "many"])
def test_planes_that_bound_the_failures_are_found(known):
    """A c.o.v. of 0.007 to 0.008, from fewer points than dimensions too; without half-spaces 0.025 to 0.4."""
    result = samplers.estimate(known.problem, TS(), seed=1, max_sim=6000)
    assert abs(result.p / known.p - 1) < 4 * result.cov < 4 * 0.012


def test_subset_simulation_takes_over(recorder):
    reference = case("slabs_d20")
    result = counted(recorder, reference.problem, seed=0, max_sim=6000)
    assert result.remarks[0].startswith("No proposal describes the failures")
    assert result.interval[0] < reference.p < result.interval[1]
    assert 0.15 < result.cov < 1
    assert result.n_sim <= 6000


def test_the_more_regions_are_met_the_more_may_be_unseen():
    """12 searches that led to K regions are worth 24 / (1 + K) to each; 97.5 % points of Beta(1/10, nu)."""
    for regions, worth in ((1, 12.0), (2, 8.0), (5, 4.0)):
        found = Discovery(searches=12.0, regions=regions)
        assert found.lineages == worth
        assert found.unseen_share(0.95) == pytest.approx(stats.beta(0.1, worth).ppf(0.975))


@pytest.mark.parametrize("max_sim", [800, 1500])
def test_a_small_exploration_says_so(max_sim):
    result = samplers.estimate(half_space(3, 3.0).problem, TS(), seed=0, max_sim=max_sim)
    assert any("misses one" in text for text in result.remarks) == (max_sim < 1500)


@pytest.mark.slow
@pytest.mark.parametrize(
    "reference",
    [half_space(100), half_space(6, 5.0), two_regions(30), shell(), deceptive(), noisy()],
    ids=lambda r: r.name,
)
def test_right_and_covered_with_many_seeds(study, reference):
    found = study(reference, TS(), 40)
    found.check(0.005)
    assert 0.6 < found.own_cov / found.ratios.std(ddof=1) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slabs_d20", "squares_d50"])
def test_subset_simulation_is_right_and_covered(study, name):
    study(case(name), TS(), 40).check(0.05)


@pytest.mark.slow
def test_hardly_any_bias_where_plain_draws_take_over(study):
    """Whether a tenth of the base draws fails decides on the rest, and they count: 0.8 % too high at p = 0.1."""
    p, beta = 0.1, -stats.norm.ppf(0.1)
    study(reference("common", lambda u: beta - u[:, 0], 2, p), TS(), 100, max_sim=2000).check(0.008)
